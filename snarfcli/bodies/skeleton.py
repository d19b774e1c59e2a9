"""The joint tree of a subject, and the canonical pose of its avatar."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from snarfcli.bodies.kinematics import forward_kinematics, invert_rigid
from snarfcli.field_docs import documented
from snarfcli.precision import without_autocast

__all__ = [
    "CANONICAL_HIP_RAD",
    "MAX_JOINTS",
    "SMPLH_JOINT_NAMES",
    "SMPLX_JOINT_NAMES",
    "SMPL_JOINT_NAMES",
    "Skeleton",
    "legs_apart_pose",
]

SMPL_JOINT_NAMES = (
    "pelvis", "l_hip", "r_hip", "spine1", "l_knee", "r_knee", "spine2", "l_ankle", "r_ankle", "spine3",
    "l_foot", "r_foot", "neck", "l_collar", "r_collar", "head", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow",
    "l_wrist", "r_wrist", "l_hand", "r_hand",
)  # fmt: skip

_FINGER_JOINT_NAMES = tuple(
    f"{side}_{finger}{number}"
    for side in ("l", "r")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for number in (1, 2, 3)
)
# SMPL-H and SMPL-X have the joints of SMPL up to the wrists.
SMPLH_JOINT_NAMES = (*SMPL_JOINT_NAMES[:22], *_FINGER_JOINT_NAMES)
SMPLX_JOINT_NAMES = (*SMPL_JOINT_NAMES[:22], "jaw", "l_eye", "r_eye", *_FINGER_JOINT_NAMES)

_SIDES = {"l": "r", "L": "R", "left": "right", "Left": "Right", "LEFT": "RIGHT"}
_SIDES |= {right: left for left, right in _SIDES.items()}
# A word of its own, a letter before a capital, or left and right in a word: l_hip, hip.L, Ear_R_tip, lThigh, LeftArm, hand_left
_SIDE = re.compile("^[lr](?=[A-Z])|(?<![A-Za-z])[lLrR](?![A-Za-z])|left|right|Left|Right|LEFT|RIGHT")

MAX_JOINTS = 1000
"""Maximum number of joints in a file: SMPL-X has 55, a character with fingers and face about 200."""
_FARTHEST_M = 1e5

CANONICAL_HIP_RAD = torch.pi / 6
"""Outward rotation of each leg in the canonical pose (SNARF's released code: 30 degrees)."""


def legs_apart_pose(names: tuple[str, ...], dtype: torch.dtype = torch.float32) -> Tensor:
    """Return the pose [J, 3], axis-angle, radians, that spreads the legs of a T-posed body; zero if there are no hips.

    The body has y up and faces +z. With the legs apart, skinning weights learned on one leg do not affect the other.
    """
    pose = torch.zeros(len(names), 3, dtype=dtype)
    for name, sign in (("l_hip", 1.0), ("r_hip", -1.0)):  # left is +x: rotation about +z moves a hanging leg towards +x
        if name in names:
            pose[names.index(name), 2] = sign * CANONICAL_HIP_RAD
    return pose


def _other_side(name: str) -> str:
    """Return the name of the joint on the other side; the same name if it names no side."""
    return _SIDE.sub(lambda match: _SIDES[match[0]], name, count=1)


@documented
@dataclass(frozen=True, eq=False)
class Skeleton:
    """A joint tree with its rest joints and its canonical pose."""

    names: tuple[str, ...]
    """J joint names; those of the two sides differ in `l` and `r`, or `left` and `right`, as a word: `l_hip`, `Ear_R`."""
    parents: tuple[int, ...]
    """J parents, -1 for the root; a parent comes before its children."""
    joints_rest: Tensor
    """[J, 3], joint positions in the rest pose, metres."""
    canonical_pose: Tensor
    """[J, 3], pose of the canonical frame relative to the rest pose, axis-angle, radians."""
    idle: tuple[int, ...] = ()
    """Joints that move no part of the subject, such as a root on the floor: they only place other joints."""

    def __post_init__(self) -> None:
        joints = len(self.parents)
        for name in ("joints_rest", "canonical_pose"):
            if getattr(self, name).shape != (joints, 3):
                raise ValueError(f"{name}: wanted shape [{joints}, 3], got {list(getattr(self, name).shape)}")
        if len(self.names) != joints:
            raise ValueError(f"names: wanted {joints} names, one per parent, got {len(self.names)}")
        if not all(0 <= joint < joints for joint in self.idle) or len(self.idle) >= joints > 0:
            raise ValueError(f"idle: wanted some joints from 0 to {joints - 1}, but not all, got {list(self.idle)}")

    @property
    def num_joints(self) -> int:
        """J, the number of joints, which is also the number of bones."""
        return len(self.parents)

    @property
    def bones(self) -> list[tuple[int, int]]:
        """Pairs (parent, child) of joints, one per joint except the root."""
        return [(parent, joint) for joint, parent in enumerate(self.parents) if parent >= 0]

    @property
    def left_right(self) -> tuple[int, ...]:
        """Per joint, the index of its counterpart on the other side by its name; its own index if there is none."""
        numbers = {name: joint for joint, name in enumerate(self.names)}
        return tuple(numbers.get(_other_side(name), joint) for joint, name in enumerate(self.names))

    @property
    def canonical_joints(self) -> Tensor:
        """[J, 3], joint positions in the canonical frame, metres."""
        return forward_kinematics(self.canonical_pose[None], self.joints_rest, self.parents)[0][0]

    def posed_from_rest(self, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return the bone transforms [B, J, 4, 4] from the rest pose to `pose` [B, J, 3], axis-angle, radians."""
        return forward_kinematics(pose, self.joints_rest.to(pose), self.parents, translation)[1]

    @without_autocast
    def posed_from_canonical(self, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        """Return the bone transforms from the canonical frame to a pose (SNARF's B_j, Eq. 4).

        Args:
            pose: [B, J, 3], axis-angle, radians, global orientation included; the result has its dtype and device.
            translation: [B, 3], metres, none by default.

        Returns:
            [B, J, 4, 4], rigid transforms, metres.
        """
        canonical_from_rest = self.posed_from_rest(self.canonical_pose[None].to(pose))
        return self.posed_from_rest(pose, translation) @ invert_rigid(canonical_from_rest)

    def to(self, *args: Any, **kwargs: Any) -> Skeleton:
        """Convert both tensors as `Tensor.to` does."""
        joints_rest, pose = self.joints_rest.to(*args, **kwargs), self.canonical_pose.to(*args, **kwargs)
        return replace(self, joints_rest=joints_rest, canonical_pose=pose)

    def to_dict(self) -> dict[str, Any]:
        """Return the content as plain lists and tensors, which `torch.load(weights_only=True)` accepts."""
        return {
            "names": list(self.names),
            "parents": list(self.parents),
            "joints_rest": self.joints_rest.detach().cpu(),
            "canonical_pose": self.canonical_pose.detach().cpu(),
        } | ({"idle": list(self.idle)} if self.idle else {})

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Skeleton:
        """Return the skeleton of a dictionary from `to_dict`; arrays and lists are accepted in place of tensors.

        Raises:
            KeyError, ValueError: the content, which may be from any file, does not describe a skeleton.
        """
        names, parents = list(content["names"]), list(content["parents"])
        idle = list(content.get("idle", ()))  # files of before have none
        if not 0 < len(parents) <= MAX_JOINTS:
            raise ValueError(f"skeleton.parents: wanted 1 to {MAX_JOINTS} joints, got {len(parents)}")
        if not all(isinstance(name, str) for name in names):
            raise ValueError("skeleton.names: wanted texts, got other values")
        if not all(isinstance(joint, (int, np.integer)) and not isinstance(joint, bool) for joint in (*parents, *idle)):
            raise ValueError("skeleton.parents, skeleton.idle: wanted whole numbers, got other values")
        if not all(-1 <= int(parent) < joint for joint, parent in enumerate(parents)):
            raise ValueError("skeleton.parents: wanted -1 for a root, and parents before their children, got other numbers")
        places = [torch.as_tensor(content[name]) for name in ("joints_rest", "canonical_pose")]
        for name, values in zip(("joints_rest", "canonical_pose"), places, strict=True):
            if not values.is_floating_point() or not bool((values.abs() < _FARTHEST_M).all()):
                raise ValueError(f"skeleton.{name}: wanted finite numbers below {_FARTHEST_M:g}, got others")
        return cls(
            names=tuple(str(name) for name in names),
            parents=tuple(int(parent) for parent in parents),
            joints_rest=places[0],
            canonical_pose=places[1],
            idle=tuple(int(joint) for joint in idle),
        )
