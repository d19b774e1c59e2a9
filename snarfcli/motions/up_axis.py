"""The up axis of motions: guess it from the poses, and rotate motions to y up."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.motions.anatomy import JOINTS_REST, PARENTS

__all__ = ["UPS", "Up", "hangs_head_down", "up_axis", "upright", "y_from_up"]

Array = NDArray[np.float64]

Up = Literal["auto", "y", "z", "x", "-y", "-z", "-x"]
"""Up axis of a file; `auto` guesses it. `-y` is the frame of a camera whose y points down."""
UPS: tuple[Up, ...] = ("auto", "y", "z", "x", "-y", "-z", "-x")
"""The values of `Up`."""

_TURNS_DEG: dict[str, tuple[str, float]] = {
    "y": ("x", 0), "-y": ("x", 180), "z": ("x", -90), "-z": ("x", 90), "x": ("z", 90), "-x": ("z", -90),
}  # fmt: skip
_ANKLES, _HEAD = (7, 8), 15
_NO_MEAN = 0.2  # length of a mean of unit vectors that says nothing
# A clip is upside down if the head is below the feet in nearly all frames, and by much on average: a handstand among other
# exercises, a somersault or a cartwheel is not.
_DOWN_SHARE = 0.95
_MAX_FRAMES = 2000  # that are looked at, spread over the clip
_DOWN_MEAN = -0.5


def up_axis(root_rotations: Rotation) -> Literal["y", "z"]:
    """Return the axis along which a body stands on average over T frames; if it turns over, in the first and last frame.

    Args:
        root_rotations: T rotations of the root in the world; the body at rest is upright along y.
    """
    spines = root_rotations.apply([0.0, 1.0, 0.0])
    spine = spines.mean(0)
    if np.linalg.norm(spine[1:]) < _NO_MEAN:
        spine = spines[0] + spines[-1]
    return "z" if abs(spine[2]) > abs(spine[1]) else "y"


def hangs_head_down(poses: Array, *, is_likely: bool) -> bool:
    """Return whether a body hangs head down along y during the whole clip, as in the frame of a camera with y down.

    Args:
        poses: [T, K, 3], axis-angle, radians; the first 22 joints are those of SMPL.
        is_likely: whether the file has other signs of a camera; then the average over the clip decides.
    """
    some = np.unique(np.linspace(0, len(poses) - 1, _MAX_FRAMES).round().astype(int))
    down = -_from_feet_to_head(poses[some])[:, 1]
    if is_likely:
        return bool(down.mean() > 0)
    return bool((down > 0).mean() >= _DOWN_SHARE and down.mean() > -_DOWN_MEAN)


def _from_feet_to_head(poses: Array) -> Array:
    """Return the unit vectors [T, 3] from the middle of the ankles to the head of an average body."""
    turns = Rotation.from_rotvec(poses[:, :22].reshape(-1, 3)).as_matrix().reshape(len(poses), 22, 3, 3)
    rotations = [turns[:, 0]]
    places = [np.zeros((len(poses), 3))]
    for joint in range(1, 22):
        parent = PARENTS[joint]
        rotations.append(rotations[parent] @ turns[:, joint])
        places.append(places[parent] + rotations[parent] @ (JOINTS_REST[joint] - JOINTS_REST[parent]))
    way = places[_HEAD] - (places[_ANKLES[0]] + places[_ANKLES[1]]) / 2
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)


def y_from_up(up: Up) -> Rotation:
    """Return the rotation of the world from an up axis to y up; `auto` counts as y."""
    axis, degrees = _TURNS_DEG["y" if up == "auto" else up]
    return Rotation.from_euler(axis, degrees, degrees=True)


def upright(poses: Array, translation: Array, root_rest: Array, up: Up) -> tuple[Array, Array]:
    """Rotate a motion from an up axis to y up.

    Args:
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
        root_rest: [3], root joint in the rest pose, metres; poses rotate about it, so it affects the translation.
        up: up axis of the motion.

    Returns:
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
    """
    if up in ("auto", "y"):
        return poses, translation
    rotation = y_from_up(up)
    poses = poses.copy()
    poses[:, 0] = (rotation * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, rotation.apply(translation + root_rest) - root_rest
