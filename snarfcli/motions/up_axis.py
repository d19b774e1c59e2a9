"""Which way is up: files with z up are turned so that y is."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["UPS", "Up", "up_axis", "y_from_z_up", "y_up_from_z_up"]

Up = Literal["auto", "y", "z"]
UPS = ("auto", "y", "z")


def up_axis(root_turns: Rotation) -> Literal["y", "z"]:
    """Return the axis along which a body, at rest upright along y, stands on average over its root's world rotations [T]."""
    spine = root_turns.apply([0.0, 1.0, 0.0]).mean(0)
    return "z" if abs(spine[2]) > abs(spine[1]) else "y"


def y_from_z_up() -> Rotation:
    """Return the turn of the world, by -90 degrees about x, that makes z up y up."""
    return Rotation.from_euler("x", -90, degrees=True)


def y_up_from_z_up(
    poses: NDArray[np.float64], translation: NDArray[np.float64], root_rest: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn the world of poses [T, J, 3] and translation [T, 3] so that z becomes y.

    The root turns about where it stands, `root_rest` [3] plus the translation, so a turn of the world moves it too.
    """
    turn = y_from_z_up()
    poses = poses.copy()
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, turn.apply(translation + root_rest) - root_rest
