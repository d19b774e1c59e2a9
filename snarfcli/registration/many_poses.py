"""A surface in many poses at once, without pose correctives: fast enough to look through a library of poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodySurface
from snarfcli.registration.kinematics import kinematics

__all__ = ["posed_many"]

Array = NDArray[np.float64]


def posed_many(surface: BodySurface, rotations: Array, betas: Array) -> tuple[Array, Array]:
    """Return points and normals [C, K, 3] of a surface in many poses, metres, the root in its place of the rest pose.

    Args:
        surface: the body.
        rotations: [C, J, 3, 3], relative to the parents.
        betas: [S], shape parameters of all.
    """
    rest = surface.rest_joints(betas)
    turns, joints = kinematics(surface.parents, rest, rotations)
    count = len(rotations)
    blended = (surface.weights @ turns.reshape(count, -1, 9)).reshape(count, -1, 3, 3)
    shifts = joints - (turns @ rest[..., None])[..., 0]
    points = (blended @ (surface.points_rest + surface.points_by_beta @ betas)[..., None])[..., 0] + surface.weights @ shifts
    normals = (blended @ surface.normals_rest[..., None])[..., 0]
    return points, normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
