"""The up axis of motions: guess it from the poses, and rotate motions with z up to y up."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["UPS", "Up", "up_axis", "y_from_z_up", "y_up_from_z_up"]

Up = Literal["auto", "y", "z"]
"""Up axis of a file; `auto` guesses it."""
UPS = ("auto", "y", "z")
"""The values of `Up`."""


def up_axis(root_rotations: Rotation) -> Literal["y", "z"]:
    """Return the axis along which a body stands on average over T frames.

    Args:
        root_rotations: T rotations of the root in the world; the body at rest is upright along y.
    """
    spine = root_rotations.apply([0.0, 1.0, 0.0]).mean(0)
    return "z" if abs(spine[2]) > abs(spine[1]) else "y"


def y_from_z_up() -> Rotation:
    """Return the rotation of the world, by -90 degrees about x, from z up to y up."""
    return Rotation.from_euler("x", -90, degrees=True)


def y_up_from_z_up(
    poses: NDArray[np.float64], translation: NDArray[np.float64], root_rest: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotate a motion from z up to y up.

    Args:
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
        root_rest: [3], root joint in the rest pose, metres; poses rotate about it, so it affects the translation.

    Returns:
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
    """
    rotation = y_from_z_up()
    poses = poses.copy()
    poses[:, 0] = (rotation * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, rotation.apply(translation + root_rest) - root_rest
