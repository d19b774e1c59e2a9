"""Forward kinematics of many poses as NumPy arrays, float64: the inner loops of the fit use no tensors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["kinematics"]

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
