"""Correspondences under a forward map that is more than blending: offsets, blend shapes, any function of PyTorch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from snarfcli.deformer.callables import with_pose
from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.map_roots import MapSettings, PosedMap, search_map
from snarfcli.deformer.search_config import SearchConfig, as_search_config, check_search_config
from snarfcli.deformer.starts import check_starts

__all__ = ["find_correspondences_on_map"]


def find_correspondences_on_map(
    points: Tensor,
    forward: Callable[..., Tensor],
    starts: Tensor,
    grid: CanonicalGrid | None = None,
    *,
    search: SearchConfig | str = "broyden",
    points_at_once: int = 32_768,
) -> Correspondences:
    """Find the canonical points that any forward map moves onto the given posed points.

    From each start Broyden's method runs on the map itself; whether there are roots beyond those that it reaches is not known.

    Args:
        points: [B, N, 3], queries, posed space, metres. A non-finite point has no correspondence.
        forward: canonical points [K, 3] to posed points [K, 3], metres. If it has a parameter named `pose_index`, it also gets
            the pose of each point, [K], 0 to B - 1. It may be any function of PyTorch that treats each row on its own, gives
            the same answer for the same point, and is differentiable by the points. It is called in chunks, with autocast off.
        starts: [B, N, I, 3], canonical, metres; one that is not finite is no start. They get no gradient. Useful ones are the
            images of the points under inverse bone transforms, and the roots of the frame before.
        grid: canonical box to which iterates are clamped, so that all roots lie in it. Its longest side is the unit of
            `search.tolerance` and `search.divergence`. None for no bounds, with one metre as the unit.
        search: settings of the search; its name must be "broyden", and its backend is not used.
        points_at_once: maximum number of iterates, and of roots, per evaluation of the map; bounds the memory.

    Returns:
        The correspondences without duplicates, those of a query in the order of the starts. They are differentiable in `points`
        and everything that `forward` depends on, by implicit differentiation at the roots; the iterations are not
        differentiated. There is no second derivative.

    Raises:
        ValueError: a shape or name does not fit, or the result of `forward` has another shape or no derivative by the points;
            the message names the argument, what was wanted and what came.
        TypeError: a dtype is not float32 or float64, or the dtypes differ.

    Source: SNARF Eq. 5-8 and 14, with another map in the place of linear blend skinning.
    """
    search = as_search_config(search)
    _check(points, starts, search)
    box = None if grid is None else grid.to(points)
    settings = MapSettings.of(search, box, 1.0 if box is None else box.longest_side, points_at_once)
    forward = with_pose(forward)
    return search_map(points, lambda b: _GivenMap(forward, b), lambda b, some: starts[b, some], starts.shape[2], settings)


class _GivenMap(PosedMap):
    """A function of canonical points [K, 3] and pose indices [K], in one pose."""

    def __init__(self, forward: Callable[[Tensor, Tensor], Tensor], pose: int) -> None:
        self.forward, self.pose = forward, pose

    def __call__(self, x: Tensor) -> Tensor:
        posed = self.forward(x, torch.full((len(x),), self.pose, device=x.device))
        if not isinstance(posed, Tensor) or posed.shape != x.shape:
            came = list(posed.shape) if isinstance(posed, Tensor) else type(posed).__name__
            raise ValueError(f"forward: wanted posed points of shape {list(x.shape)}, got {came}")
        if posed.dtype != x.dtype:
            raise TypeError(f"forward: wanted posed points of the dtype of points, {x.dtype}, got {posed.dtype}")
        return posed


def _check(points: Tensor, starts: Tensor, search: SearchConfig) -> None:
    """Raise ValueError or TypeError if arguments do not fit together."""
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points: wanted shape [B, N, 3], got {list(points.shape)}")
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"points: wanted float32 or float64, got {points.dtype}")
    if search.name != "broyden":
        raise ValueError(f"search.name: wanted broyden, got {search.name!r}: a map has no cells to search")
    check_starts(starts, points, search)
    check_search_config(search, 0)
