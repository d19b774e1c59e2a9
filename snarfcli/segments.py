"""Distances to line segments, such as the bones of a skeleton."""

from __future__ import annotations

from torch import Tensor

__all__ = ["distance_to_segments", "segment_distances"]


def segment_distances(points: Tensor, segments: Tensor) -> Tensor:
    """Return the distance of points [N, 3] to each of the segments [S, 2, 3] (start, end), [N, S], metres.

    A segment may have length 0.
    """
    start = segments[:, 0]
    along = segments[:, 1] - start
    length = (along * along).sum(1).clamp_min(1e-12)
    # |p - a - t(b - a)|^2 written out by dot products, so that the largest array is [N, S] and not [N, S, 3].
    from_start = points @ along.T - (start * along).sum(1)
    share = (from_start / length).clamp(0, 1)
    to_start = (points * points).sum(1, keepdim=True) - 2 * points @ start.T + (start * start).sum(1)
    squared = to_start - 2 * share * from_start + share * share * length
    return squared.clamp_min(1e-12).sqrt()


def distance_to_segments(points: Tensor, segments: Tensor) -> Tensor:
    """Return the distance of points [N, 3] to the nearest of the segments [S, 2, 3], [N], metres."""
    return segment_distances(points, segments).amin(1)
