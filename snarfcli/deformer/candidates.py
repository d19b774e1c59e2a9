"""Which queries lie in which boxes, by sorting the queries into bins."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from snarfcli.deformer.cell_polynomials import pick

__all__ = ["pairs_in_boxes"]

_BINS_PER_SIDE = 96  # at most; bounds the memory, as does:
_PAIRS_AT_ONCE = 2_000_000
_FARTHEST = 1e15  # metres; squares of larger coordinates are no float32 numbers


def pairs_in_boxes(points: Tensor, lower: Tensor, upper: Tensor, poses: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield all pairs (query [P], box [P]) of the same pose where the query lies in the box, box by box.

    The queries are sorted into uniform bins, x fastest, so that a run of bins along x is one contiguous range of queries.

    Args:
        points: [3, G * N], queries of G poses.
        lower, upper: [3, G * C], corners of C boxes in each pose. Boxes that are not finite or absurdly far away
            contain nothing.
        poses: G.
    """
    boxed = ((lower > -_FARTHEST) & (upper < _FARTHEST)).all(0)
    if not points.shape[1] or not bool(boxed.any()):
        return
    # Queries outside every box need no bin; comparisons with non-finite ones are false.
    least, most = lower[:, boxed].amin(1, keepdim=True), upper[:, boxed].amax(1, keepdim=True)
    known = ((points >= least) & (points <= most)).all(0).nonzero()[:, 0]
    if not len(known):
        return
    near, per_pose = pick(points, known), points.shape[1] // poses
    per_side = min(_BINS_PER_SIDE, 4 * math.ceil(per_pose ** (1 / 3)))
    first, last = near.amin(1, keepdim=True), near.amax(1, keepdim=True)
    side = max(float((last - first).max()) / per_side, float((upper - lower)[:, boxed].mean()), 1e-9)
    bins = _Bins(near, known // per_pose, poses, side)
    near, known = pick(near, bins.order), pick(known, bins.order)
    touched = (boxed & (upper >= first).all(0) & (lower <= last).all(0)).nonzero()[:, 0]
    owner, begin, end = bins.ranges(pick(lower, touched), pick(upper, touched), touched // (lower.shape[1] // poses))
    at_once = ((end - begin).cumsum(0) // _PAIRS_AT_ONCE).unique_consecutive(return_counts=True)[1].tolist()
    for some in zip(*(values.split(at_once) for values in (pick(touched, owner), begin, end)), strict=True):
        box, at = _expand(*some)
        inside = torch.ones_like(at, dtype=torch.bool)
        for values, least, most in zip(near, lower, upper, strict=True):
            value = pick(values, at)
            inside &= (value >= pick(least, box)) & (value <= pick(most, box))
        inside = inside.nonzero()[:, 0]
        yield pick(known, pick(at, inside)), pick(box, inside)


class _Bins:
    """Points sorted into cubes of space, pose by pose, x fastest.

    Args:
        points: [3, N], at least one, finite.
        pose: [N], 0 to G - 1.
        poses: G.
        side: of a bin, metres.
    """

    def __init__(self, points: Tensor, pose: Tensor, poses: int, side: float) -> None:
        self.lower, self.side = points.amin(1, keepdim=True), side
        self.counts = ((points.amax(1, keepdim=True) - self.lower) / side).long() + 1
        x, y, z = self._place(points)
        key = ((pose * self.counts[2] + z) * self.counts[1] + y) * self.counts[0] + x
        self.order = torch.argsort(key, stable=True)
        """[N], indices of the points, bin by bin."""
        self.begin = torch.zeros(poses * int(self.counts.prod()) + 1, dtype=torch.long, device=points.device)
        """Where each bin begins in `order`, and the end."""
        self.begin[1:] = torch.bincount(key, minlength=len(self.begin) - 1).cumsum(0)

    def _place(self, points: Tensor) -> Tensor:
        """Return the bins [3, K] along x, y, z of points [3, K], the nearest for those outside."""
        return ((points - self.lower) / self.side).clamp_min(0).minimum(self.counts - 1).long()

    def ranges(self, lower: Tensor, upper: Tensor, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return ranges of `order` that together hold all points in boxes [3, K] of the same pose [K].

        Returns:
            The index of the range's box, its begin and its end, [R] each. A range is a row of bins along x.
        """
        low, high = self._place(lower), self._place(upper)
        rows = high[1:] - low[1:] + 1
        count = rows.prod(0)
        owner, nth = _expand(torch.arange(len(count), device=count.device), torch.zeros_like(count), count)
        y, z = pick(low[1], owner) + nth % rows[0][owner], pick(low[2], owner) + nth // rows[0][owner]
        row = ((pose[owner] * self.counts[2] + z) * self.counts[1] + y) * self.counts[0]
        return owner, self.begin[row + pick(low[0], owner)], self.begin[row + pick(high[0], owner) + 1]


def _expand(owner: Tensor, begin: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Return the owner of each number in ranges [R], and the number; both [sum of the ranges' lengths]."""
    count = end - begin
    which = torch.repeat_interleave(count)
    number = torch.arange(len(which), device=which.device) + pick(begin + count - count.cumsum(0), which)
    return pick(owner, which), number
