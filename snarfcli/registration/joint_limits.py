"""Anatomical angles of poses, joints near their limits, and poses by chance inside the limits; see `motions.anatomy`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.motions.anatomy import LIMITS_DEG, poses_from_angles
from snarfcli.motions.layouts import BODY_JOINTS, SMPL, carry_over
from snarfcli.motions.plain_names import plain_name

__all__ = ["angles_from_poses", "near_limits", "random_poses"]

Array = NDArray[np.float64]

_NEAR_DEG = 3.0  # a joint is near a limit that is closer than this, or passed
_FREE = {"elbow": -10.0, "knee": -10.0}  # straight limbs are usual: lower limits, degrees, of what counts as near the limit
_LONGEST_SWING_DEG = 165.0  # of an upper arm by chance; further, the two components of the swing are not those of a pose
_MIRROR = np.diag([-1.0, 1.0, 1.0])
_JOINTS_OF_ANGLES = {
    "spine": "spine3", "head": "head", "hip": "hip", "knee": "knee", "ankle": "ankle", "toe": "foot", "shrug": "collar",
    "protract": "collar", "arm": "shoulder", "elbow": "elbow", "pron": "wrist", "wrist": "wrist", "curl": "hand",
}  # fmt: skip
"""SMPL's name of the joint, without side, by the first word of an angle's name."""


def angles_from_poses(joint_names: Sequence[str], poses: Array) -> dict[str, Array]:
    """Return the anatomical angles of poses: the inverse of `motions.anatomy.poses_from_angles`.

    Turns that an angle does not describe, such as those of a knee to the side, are left out.

    Args:
        joint_names: J joint names, in any spelling and order.
        poses: [T, J, 3], axis-angle, radians.

    Returns:
        [T], degrees, per name of `LIMITS_DEG` but those of the pelvis; nothing unless the body has SMPL's joints.
    """
    names = tuple(plain_name(name) for name in joint_names)
    if not set(BODY_JOINTS) <= set(names):
        return {}
    turns = {name: Rotation.from_rotvec(poses[:, joint]) for joint, name in enumerate(names) if name in SMPL}
    spine = (turns["spine1"] * turns["spine2"] * turns["spine3"]).as_rotvec(degrees=True)
    head = (turns["neck"] * turns["head"]).as_rotvec(degrees=True)
    angles = {
        "spine_flex": spine[:, 0], "spine_bend": -spine[:, 2], "spine_twist": spine[:, 1],
        "head_nod": head[:, 0], "head_tilt": -head[:, 2], "head_turn": head[:, 1],
    }  # fmt: skip
    for side in "lr":
        parts = {name[2:]: turn for name, turn in turns.items() if name.startswith(f"{side}_")}
        if side == "r":
            parts = {name: Rotation.from_matrix(_MIRROR @ turn.as_matrix() @ _MIRROR) for name, turn in parts.items()}
        angles |= {f"{side}_{name}": value for name, value in {**_left_leg(parts), **_left_arm(parts)}.items()}
    return angles


def near_limits(joint_names: Sequence[str], poses: Array) -> dict[str, NDArray[np.intp]]:
    """Return the numbers of the poses [T, J, 3] in which a joint is near a limit or past it, by joint in the body's spelling.

    Joints that never are have no entry. Straight elbows and knees count only if they are bent backwards. A body without SMPL's
    joints has no limits.
    """
    spellings = {plain_name(name): name for name in joint_names}
    near: dict[str, NDArray[np.bool_]] = {}
    for name, values in angles_from_poses(joint_names, poses).items():
        side, part = (name[:2], name[2:]) if name[:2] in ("l_", "r_") else ("", name)
        low, high = LIMITS_DEG[name]
        is_far = (values > _FREE.get(part, low) + _NEAR_DEG) & (values < high - _NEAR_DEG)
        joint = spellings[side + _JOINTS_OF_ANGLES[part.partition("_")[0]]]
        near[joint] = near.get(joint, False) | ~is_far
    return {joint: np.flatnonzero(is_near) for joint, is_near in near.items() if is_near.any()}


def random_poses(joint_names: Sequence[str], count: int, seed: int = 0) -> Array | None:
    """Return upright poses [C, J, 3] whose angles are anywhere inside their limits; None for a body without SMPL's joints."""
    names = tuple(plain_name(name) for name in joint_names)
    if not set(BODY_JOINTS) <= set(names):
        return None
    draws = np.random.default_rng(seed)
    angles = {name: draws.uniform(*limits, count) for name, limits in LIMITS_DEG.items() if not name.startswith("pelvis")}
    for side in "lr":
        flex, abd = f"{side}_arm_flex", f"{side}_arm_abd"
        shorter = np.minimum(1.0, _LONGEST_SWING_DEG / np.hypot(angles[flex], angles[abd]))
        angles[flex], angles[abd] = angles[flex] * shorter, angles[abd] * shorter
    return carry_over(poses_from_angles(angles, count), SMPL, names, "rest")


def _left_leg(parts: dict[str, Rotation]) -> dict[str, Array]:
    swing, turn = _swing_and_twist(parts["hip"], 1)
    return {
        "hip_flex": -swing[:, 0],
        "hip_abd": swing[:, 2] + 9,  # the rest pose has the legs apart
        "hip_rot": turn,
        "knee": _twist(parts["knee"], 0),
        "ankle": -_twist(parts["ankle"] * Rotation.from_euler("z", -9, degrees=True), 0),
        "toe": -_twist(parts["foot"], 0),
    }


def _left_arm(parts: dict[str, Rotation]) -> dict[str, Array]:
    hanging = Rotation.from_euler("z", -90, degrees=True)
    swing, roll = _swing_and_twist(parts["collar"] * parts["shoulder"] * hanging.inv(), 1)
    flex, abd = -swing[:, 0], swing[:, 2]
    lift, backward = _swing_and_twist(parts["collar"], 1)
    elbow = parts["elbow"].as_euler("YXZ", degrees=True)
    wrist = parts["wrist"].as_euler("XYZ", degrees=True)
    angles = {
        # what the shoulder blade does with the raised arm is no angle of its own
        "shrug": lift[:, 2] + 7 - 30 / (1 + np.exp(-(np.hypot(flex, abd) - 105) / 28)),
        "protract": -backward - 12 * np.sin(np.radians(np.clip(flex, -90, 90))),
        "arm_flex": flex,
        "arm_abd": abd,
        "arm_roll": roll,
        "elbow": -elbow[:, 0],
        "pron": elbow[:, 1] + wrist[:, 0],
        "wrist_flex": -wrist[:, 2],
        "wrist_dev": -wrist[:, 1],
    }
    return angles | ({"curl": -_twist(parts["hand"], 2)} if "hand" in parts else {})


def _swing_and_twist(rotation: Rotation, axis: int) -> tuple[Array, Array]:
    """Return a swing [T, 3] without part along an axis, and the twist [T] about the axis that comes before it; degrees."""
    twist = _twist(rotation, axis)
    about = Rotation.from_euler("xyz"[axis], twist[:, None], degrees=True)
    return (rotation * about.inv()).as_rotvec(degrees=True), twist


def _twist(rotation: Rotation, axis: int) -> Array:
    """Return the part of rotations that is about an axis of the parent, [T], degrees from -180 to 180."""
    quaternion = rotation.as_quat()
    half = np.arctan2(quaternion[:, axis], quaternion[:, 3])
    return np.degrees((2 * half + np.pi) % (2 * np.pi) - np.pi)
