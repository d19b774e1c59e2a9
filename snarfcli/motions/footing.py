"""Feet on the floor: inverse kinematics of planted legs, and the floor under any pose."""

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

# A knee never locks: the leg's reach is eased into this share of its full length, where the solution would turn singular.
_REACH = 0.997
_EASE_M = 0.006

# Width of the soft minimum that finds the lowest point, metres.
_SOFT_M = 0.008

# How long a body takes to come to rest on the floor, seconds.
_GIVE_S = 0.04

# Points that can touch the floor: joint, offset in the joint's frame, radius of the flesh around it, metres.
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
    """Where one foot is, frame by frame, in the world of a body that stands at its rest position."""

    x: Array
    """[T] ball of the foot, metres to the body's left of where it stands."""
    y: Array
    """[T] metres above the floor."""
    z: Array
    """[T] metres forwards of where it stands."""
    yaw: Array
    """[T] toes turned outwards, degrees."""
    heel: Array
    """[T] heel lifted above the ball, degrees."""


def plant_foot(poses: Array, translation: Array, side: str, path: FootPath) -> Array:
    """Turn hip, knee, ankle and toes of one leg so that the foot follows a path; the knee points where the toes do.

    Args:
        poses: [T, 24, 3] axis-angle, radians.
        translation: [T, 3] metres of the root.
        side: `l` or `r`.
        path: the ball's way; a foot that cannot be reached hangs in the air below a straight leg.

    Returns:
        [T, 24, 3] the poses with this leg replaced.
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
    """Orthonormal frames [T, 3, 3] whose first column is `along` and whose second leans `towards`."""
    first = along / np.linalg.norm(along, axis=1, keepdims=True)
    second = towards - (first * towards).sum(1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], -1)


def stand_on_floor(poses: Array, frame_rate: float) -> Array:
    """Return the translation with which the body rests on the floor, and what rests on it does not slide.

    Args:
        poses: [T, 24, 3] axis-angle, radians.
        frame_rate: frames a second.

    Returns:
        [T, 3] metres. Up: the lowest point touches the floor. Sideways and forwards: the points on the floor stay where they
        are from frame to frame, and the way as a whole is centred.
    """
    positions, rotations = joint_positions(poses)
    points = np.stack([positions[:, joint] + rotations[:, joint] @ np.asarray(at) for joint, at, _ in _CONTACTS], 1)
    heights = points[:, :, 1] - np.array([radius for _, _, radius in _CONTACTS])
    # A soft minimum: no jerk when another point takes over.
    lowest = -_SOFT_M * np.logaddexp.reduce(-heights / _SOFT_M, axis=1)
    share = np.exp((lowest[:, None] - heights) / (3 * _SOFT_M))
    share /= share.sum(1, keepdims=True)
    slide = np.einsum("tc,tcx->tx", (share[1:] + share[:-1]) / 2, np.diff(points, axis=0))
    translation = -np.concatenate([np.zeros((1, 3)), np.cumsum(slide, 0)])
    translation -= (translation.max(0) + translation.min(0)) / 2
    translation[:, 1] = FLOOR_Y - lowest
    # A foot that lands or leaves would stop the body dead; flesh and knees give way for a few hundredths of a second.
    return gaussian_filter1d(translation, _GIVE_S * frame_rate, axis=0, mode="nearest")
