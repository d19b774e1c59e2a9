"""A surface in many poses at once, without pose correctives: fast enough to look through a library of poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodySurface

__all__ = ["kinematics", "posed_many"]

Array = NDArray[np.float64]


def kinematics(parents: tuple[int, ...], joints_rest: Array, rotations: Array) -> tuple[Array, Array]:
    """Return rotations from the rest pose and joints of many poses, the root in its place of the rest pose.

    Args:
        parents: J parents, -1 for the root.
        joints_rest: [J, 3], metres.
        rotations: [C, J, 3, 3], relative to the parents.

    Returns:
        turns: [C, J, 3, 3].
        joints: [C, J, 3], metres.
    """
    turns, joints = np.empty_like(rotations), np.empty(rotations.shape[:-1])
    for joint, parent in enumerate(parents):
        if parent < 0:
            turns[:, joint], joints[:, joint] = rotations[:, joint], joints_rest[joint]
        else:
            turns[:, joint] = turns[:, parent] @ rotations[:, joint]
            joints[:, joint] = joints[:, parent] + turns[:, parent] @ (joints_rest[joint] - joints_rest[parent])
    return turns, joints


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
