"""Evaluate any number of points in parts, so that the memory does not grow with their number.

DESIGN. A point near the surface takes up to 0.8 kB, and a pose 1.5 MB in the complete search (24 joints, the default grid): a
part takes about 0.1 GB, so that rigs with many joints and fine grids stay below 1 GiB too. Larger parts are not faster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

__all__ = ["points_in_parts", "queries_in_parts"]

_POINTS_AT_ONCE = 65_536
_POSES_AT_ONCE = 8


def queries_in_parts(
    evaluate: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, ...]], points: Tensor, bone_transforms: Tensor, pose: Tensor
) -> tuple[Tensor, ...]:
    """Return `evaluate(points, bone_transforms, pose)`, evaluated in parts.

    Args:
        evaluate: returns tensors [B, N]. What it returns for a point must not depend on the other points.
        points: [B, N, 3].
        bone_transforms: [B, J, 4, 4].
        pose: [B, J, 3].

    Raises:
        ValueError: the arguments do not have the same number of poses.
    """
    if points.ndim != 3 or not len(points) == len(bone_transforms) == len(pose):
        shapes = f"points {list(points.shape)}, bone_transforms {list(bone_transforms.shape)}, pose {list(pose.shape)}"
        raise ValueError(f"query: wanted points [B, N, 3], bone_transforms [B, J, 4, 4] and pose [B, J, 3], got {shapes}")
    batch, count = points.shape[:2]
    parts = list(_parts(batch, count))
    if len(parts) <= 1:
        return evaluate(points, bone_transforms, pose)
    whole: tuple[Tensor, ...] = ()
    for rows, columns in parts:
        values = evaluate(points[rows, columns], bone_transforms[rows], pose[rows])
        whole = whole or tuple(value.new_empty(batch, count) for value in values)
        for all_values, value in zip(whole, values, strict=True):
            all_values[rows, columns] = value
    return whole


def _parts(batch: int, count: int) -> Iterator[tuple[slice, slice]]:
    """Yield the ranges of poses and of points of each part."""
    poses = max(1, min(_POSES_AT_ONCE, _POINTS_AT_ONCE // max(count, 1)))
    for row in range(0, batch, poses):
        for column in range(0, count, _POINTS_AT_ONCE) if count else (0,):
            yield slice(row, row + poses), slice(column, column + _POINTS_AT_ONCE)


def points_in_parts(evaluate: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Return `evaluate(points)`, [N, ...], for points [N, 3], evaluated in parts."""
    if len(points) <= _POINTS_AT_ONCE:
        return evaluate(points)
    return torch.cat([evaluate(part) for part in points.split(_POINTS_AT_ONCE)])
