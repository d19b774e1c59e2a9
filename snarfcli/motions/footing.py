"""Contact with the floor: inverse kinematics of planted legs, and the floor below any pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from snarfcli.motions.anatomy import JOINTS_REST, PARENTS, joint_positions

__all__ = ["FLOOR_Y", "FootPath", "plant_foot", "stand_on_floor"]

Array = NDArray[np.float64]

FLOOR_Y = -1.17
"""Height of the soles in the rest pose, metres."""

# The reach of a leg smoothly approaches this share of its full length, at which the solution would become singular.
_REACH = 0.997
_EASE_M = 0.006

# Width of the soft minimum that finds the lowest point, metres.
_SOFT_M = 0.008

# Time over which the contact with the floor is smoothed, seconds.
_SMOOTHING_S = 0.04

# Points that can touch the floor: joint, offset in the frame of the joint, radius of the body around it, metres.
_CONTACTS = (
    *((ankle, (0.0, -0.035, -0.055), 0.03) for ankle in (7, 8)),
    *((foot, offset, 0.012) for foot in (10, 11) for offset in ((0.02, -0.008, 0.06), (-0.03, -0.008, 0.07), (0, -0.01, 0))),
    *((knee, (0.0, 0.0, 0.015), 0.055) for knee in (4, 5)),
    *((elbow, (0.0, 0.0, 0.0), 0.042) for elbow in (18, 19)),
    *((wrist, (0.0, 0.0, 0.0), 0.03) for wrist in (20, 21)),
    *((hand, (side * reach, 0.0, 0.0), 0.016) for hand, side in ((22, 1), (23, -1)) for reach in (0.0, 0.08)),
    *((0, (x, -0.09, -0.05), 0.075) for x in (-0.08, 0.08)),
    *((9, (x, y, -0.03), 0.09) for x in (-0.09, 0.09) for y in (0.0, 0.12)),
    *((3, (0.0, 0.0, z), 0.08) for z in (-0.02, 0.04)),
    (9, (0.0, 0.05, 0.06), 0.09),
    (15, (0.0, 0.08, 0.0), 0.095),
    *((shoulder, (0.0, 0.0, 0.0), 0.055) for shoulder in (16, 17)),
    *((hip, (side * 0.05, 0.0, -0.02), 0.08) for hip, side in ((1, 1), (2, -1))),
)


@dataclass
class FootPath:
    """Path of the ball of one foot, relative to its position when standing straight."""

    x: Array
    """[T], offset to the left of the body, metres."""
    y: Array
    """[T], height above the floor, metres."""
    z: Array
    """[T], offset forwards, metres."""
    yaw: Array
    """[T], outward rotation of the toes, degrees."""
    heel: Array
    """[T], lift of the heel above the ball, degrees."""


def plant_foot(poses: Array, translation: Array, side: str, path: FootPath) -> Array:
    """Rotate hip, knee, ankle and toes of one leg so that the foot follows a path; the knee points where the toes do.

    Args:
        poses: [T, 24, 3], axis-angle, radians.
        translation: [T, 3], translation of the root, metres.
        side: `l` or `r`.
        path: path of the foot; if it is out of reach, the leg is straight and the foot stays in the air.

    Returns:
        [T, 24, 3], the poses with this leg replaced, axis-angle, radians.
    """
    right = side == "r"
    sign = -1.0 if right else 1.0
    hip, knee, ankle, ball = (joint + right for joint in (1, 4, 7, 10))
    positions, rotations = joint_positions(poses, translation)
    yaw = Rotation.from_euler("y", (sign * path.yaw)[:, None], degrees=True)
    foot = yaw * Rotation.from_euler("x", path.heel[:, None], degrees=True)
    stand = np.array([sign * 0.125, JOINTS_REST[ball, 1], JOINTS_REST[ball, 2] - 0.02])
    target = stand + np.stack([path.x, path.y, path.z], 1) + foot.apply(JOINTS_REST[ankle] - JOINTS_REST[ball])

    thigh, shank = JOINTS_REST[knee] - JOINTS_REST[hip], JOINTS_REST[ankle] - JOINTS_REST[knee]
    way = target - positions[:, hip]
    distance = np.linalg.norm(way, axis=1)
    longest = _REACH * (np.linalg.norm(thigh) + np.linalg.norm(shank))
    reach = longest - _EASE_M * np.logaddexp(0, (longest - distance) / _EASE_M)
    # |thigh + Rx(k) shank|^2 = reach^2, with thigh . Rx(k) shank = a + b cos k + c sin k
    b = thigh[1] * shank[1] + thigh[2] * shank[2]
    c = thigh[2] * shank[1] - thigh[1] * shank[2]
    dot = (reach**2 - thigh @ thigh - shank @ shank) / 2 - thigh[0] * shank[0]
    bend = np.arctan2(c, b) + np.arccos(np.clip(dot / np.hypot(b, c), -1, 1))
    knee_turn = Rotation.from_euler("x", bend[:, None])
    leg = thigh + knee_turn.apply(shank)
    heading = yaw.apply([0.0, 0.0, 1.0])
    world = Rotation.from_matrix(_frame(way, heading) @ _frame(leg, np.array([0.0, 0.0, 1.0])).transpose(0, 2, 1))
    parent = Rotation.from_matrix(rotations[:, PARENTS[hip]])
    planted = poses.copy()
    planted[:, hip] = (parent.inv() * world).as_rotvec()
    planted[:, knee] = knee_turn.as_rotvec()
    planted[:, ankle] = ((world * knee_turn).inv() * foot).as_rotvec()
    planted[:, ball] = Rotation.from_euler("x", -0.9 * path.heel[:, None], degrees=True).as_rotvec()
    return planted


def _frame(along: Array, towards: Array) -> Array:
    """Return orthonormal frames [T, 3, 3]; the first column is along `along`, the second close to `towards`."""
    first = along / np.linalg.norm(along, axis=1, keepdims=True)
    second = towards - (first * towards).sum(1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], -1)


def stand_on_floor(poses: Array, frame_rate: float) -> Array:
    """Return the translation with which the body stands on the floor without sliding.

    Args:
        poses: [T, 24, 3], axis-angle, radians.
        frame_rate: frames per second.

    Returns:
        [T, 3], metres. Vertically the lowest point touches the floor; horizontally the points on the floor do not move between
        frames, and the whole path is centred.
    """
    positions, rotations = joint_positions(poses)
    points = np.stack([positions[:, joint] + rotations[:, joint] @ np.asarray(at) for joint, at, _ in _CONTACTS], 1)
    heights = points[:, :, 1] - np.array([radius for _, _, radius in _CONTACTS])
    # A soft minimum avoids jumps when the lowest point changes.
    lowest = -_SOFT_M * np.logaddexp.reduce(-heights / _SOFT_M, axis=1)
    share = np.exp((lowest[:, None] - heights) / (3 * _SOFT_M))
    share /= share.sum(1, keepdims=True)
    slide = np.einsum("tc,tcx->tx", (share[1:] + share[:-1]) / 2, np.diff(points, axis=0))
    translation = -np.concatenate([np.zeros((1, 3)), np.cumsum(slide, 0)])
    translation -= (translation.max(0) + translation.min(0)) / 2
    translation[:, 1] = FLOOR_Y - lowest
    # Without smoothing, a foot that lands or lifts off would change the velocity of the body abruptly.
    return gaussian_filter1d(translation, _SMOOTHING_S * frame_rate, axis=0, mode="nearest")
