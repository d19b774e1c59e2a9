"""The sides of the surface around a skeleton: normals point away from the bone that a point belongs to.

Without a skeleton, sides must be told by the points alone (`normals.py`), which can fail for a whole limb. With the bones this
does not happen (`benchmarks/bm_points.py`); some sides stay wrong at fingers and toes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from snarfcli.point_clouds.neighbours import find_neighbours, plane_normals

__all__ = ["bone_normals"]

Array = NDArray[np.float64]

_PLANE_NEIGHBOURS = 14
_BEYOND = 0.7  # length of what follows the last joint of a limb, in that of the bone before: hands, toes, the top of the head
_RADIUS, _RADII = 0.05, (0.01, 0.12)  # first guess and limits of a limb's radius, in the longest side of the skeleton
_ROUNDS = 4  # of finding which points belong to a bone, and from these its radius
_LEAST_POINTS = 6  # for a radius
_POINTS_AT_ONCE = 2048


def bone_normals(points: Array, joints: Array, parents: Sequence[int]) -> Array:
    """Return unit normals [N, 3] that point away from the bones.

    A point belongs to the bone that is closest relative to the radius of its limb, so that the trunk beside an arm is not the
    arm's. The radius is the median distance of the points that belong to the bone.

    Args:
        points: [N, 3], on the surface around the bones, any unit.
        joints: [J, 3], in the same pose and unit.
        parents: J parents, -1 for a root.

    Raises:
        ValueError: there are fewer than 16 points, or one is not finite.
    """
    points = np.asarray(points, np.float64)
    normals = plane_normals(points, find_neighbours(points, _PLANE_NEIGHBOURS)[1])
    starts, ends = _bones(np.asarray(joints, np.float64), parents)
    parts = np.split(points, range(_POINTS_AT_ONCE, len(points), _POINTS_AT_ONCE))
    distances = np.concatenate([np.linalg.norm(_away(part[:, None], starts, ends), axis=2) for part in parts])
    size = float(np.ptp(joints, axis=0).max()) or float(np.ptp(points, axis=0).max())
    radii = np.full(len(starts), _RADIUS * size)
    for _ in range(_ROUNDS):
        bone = (distances / radii).argmin(axis=1)
        for number in np.flatnonzero(np.bincount(bone, minlength=len(radii)) >= _LEAST_POINTS):
            radii[number] = np.clip(np.median(distances[bone == number, number]), _RADII[0] * size, _RADII[1] * size)
    bone = (distances / radii).argmin(axis=1)
    outward = _away(points, starts[bone], ends[bone])
    return normals * np.where((normals * outward).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def _bones(joints: Array, parents: Sequence[int]) -> tuple[Array, Array]:
    """Return the starts and ends [B, 3] of the bones; a limb goes on beyond its last joint, and a lone joint is a bone."""
    pairs = [(joints[parent], joints[joint]) for joint, parent in enumerate(parents) if parent >= 0]
    for joint in sorted({*range(len(parents))} - {*parents}):
        before = joints[parents[joint]] if parents[joint] >= 0 else joints[joint]
        pairs.append((joints[joint], joints[joint] + _BEYOND * (joints[joint] - before)))
    starts, ends = np.array(pairs).transpose(1, 0, 2)
    return starts, ends


def _away(points: Array, starts: Array, ends: Array) -> Array:
    """Return the offsets of points from the closest places of segments with these starts and ends, all [..., 3]."""
    along = ends - starts
    squared = np.maximum(np.square(along).sum(axis=-1), np.finfo(float).tiny)
    share = np.clip(((points - starts) * along).sum(axis=-1) / squared, 0.0, 1.0)
    return points - starts - share[..., None] * along
