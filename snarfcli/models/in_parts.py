"""Evaluate any number of points in parts, so that the memory does not grow with their number.

DESIGN. A point near the surface takes up to 0.8 kB, and a pose 1.5 MB in the complete search (24 joints, the default grid): a
part takes about 0.1 GB, so that rigs with many joints and fine grids stay below 1 GiB too. Larger ones are not faster on a CPU.
On a GPU they are larger: for each part the host waits for it and launches about 200 kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

__all__ = ["points_at_once", "points_in_parts", "queries_in_parts"]

_POINTS_AT_ONCE = 65_536
_POINTS_AT_ONCE_ON_GPU = 262_144  # 0.2 GB
_POSES_AT_ONCE = 8


def points_at_once(device: torch.device) -> int:
    """Return the maximum number of points in a part."""
    return _POINTS_AT_ONCE if device.type == "cpu" else _POINTS_AT_ONCE_ON_GPU


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
    parts = list(_parts(batch, count, points_at_once(points.device)))
    if len(parts) <= 1:
        return evaluate(points, bone_transforms, pose)
    whole: tuple[Tensor, ...] = ()
    for rows, columns in parts:
        values = evaluate(points[rows, columns], bone_transforms[rows], pose[rows])
        whole = whole or tuple(value.new_empty(batch, count) for value in values)
        for all_values, value in zip(whole, values, strict=True):
            all_values[rows, columns] = value
    return whole


def _parts(batch: int, count: int, most: int) -> Iterator[tuple[slice, slice]]:
    """Yield the ranges of poses and of points of each part, which has at most `most` points."""
    poses = max(1, min(_POSES_AT_ONCE, most // max(count, 1)))
    for row in range(0, batch, poses):
        for column in range(0, count, most) if count else (0,):
            yield slice(row, row + poses), slice(column, column + most)


def points_in_parts(evaluate: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Return `evaluate(points)`, [N, ...], for points [N, 3], evaluated in parts."""
    most = points_at_once(points.device)
    if len(points) <= most:
        return evaluate(points)
    return torch.cat([evaluate(part) for part in points.split(most)])
