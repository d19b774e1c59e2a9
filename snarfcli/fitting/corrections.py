"""Corrections of poses: a turn of every joint and a shift of the whole body, also for bones that stretch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.bodies import Skeleton, axis_angle_to_matrix, matrix_to_axis_angle
from snarfcli.bodies.kinematics import nearest_rotation

__all__ = ["Corrections", "Corrector", "bone_turns"]


@dataclass(frozen=True)
class Corrections:
    """Corrections of B poses."""

    turn: Tensor
    """[B, J, 3], rotation of each joint, which its descendants follow: axis-angle, radians, in the axes of the canonical frame,
    moved with the bone."""
    shift: Tensor
    """[B, 3], of the whole body, posed frame, metres."""

    @classmethod
    def none(cls, batch: int, joints: int, like: Tensor) -> Corrections:
        """Return corrections that change nothing, with the dtype and device of `like`."""
        return cls(like.new_zeros(batch, joints, 3), like.new_zeros(batch, 3))

    def then(self, turn: Tensor, shift: Tensor) -> Corrections:
        """Return these corrections followed by small ones, whose turns are in the axes of the bones corrected so far."""
        combined = axis_angle_to_matrix(self.turn) @ axis_angle_to_matrix(turn)
        return Corrections(matrix_to_axis_angle(combined), self.shift + shift)

    def to(self, device: torch.device) -> Corrections:
        """Return the corrections on a device."""
        return Corrections(self.turn.to(device), self.shift.to(device))

    def put(self, index: Tensor, others: Corrections) -> None:
        """Replace the corrections of the poses with indices [K]."""
        self.turn[index] = others.turn.to(self.turn)
        self.shift[index] = others.shift.to(self.shift)

    def take(self, index: Tensor) -> Corrections:
        """Return the corrections of the poses with indices [K]."""
        return Corrections(self.turn[index], self.shift[index])


def bone_turns(bone_transforms: Tensor) -> Tensor:
    """Return the rotations [..., 3, 3] of bone transforms [..., 4, 4], without the scale or shear of bones that stretch."""
    return nearest_rotation(bone_transforms[..., :3, :3])


class Corrector:
    """Applies corrections to poses of a skeleton.

    Args:
        skeleton: joint tree and canonical pose.
        device: on which to compute, in float32.
    """

    def __init__(self, skeleton: Skeleton, device: torch.device) -> None:
        self.parents = skeleton.parents
        skeleton = skeleton.to(device=device, dtype=torch.float32)
        self._joints = skeleton.canonical_joints
        # The axes of the canonical frame in those of each joint at rest, in which poses are given.
        self._axes = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0, :, :3, :3]

    def joints(self, bone_transforms: Tensor) -> Tensor:
        """Return the posed joints [B, J, 3] under bone transforms [B, J, 4, 4], metres."""
        return (bone_transforms[..., :3, :3] @ self._joints[:, :, None])[..., 0] + bone_transforms[..., :3, 3]

    def correct(self, bone_transforms: Tensor, pose: Tensor, corrections: Corrections) -> tuple[Tensor, Tensor]:
        """Apply corrections.

        Args:
            bone_transforms: [B, J, 4, 4], canonical to posed, metres. They need not be those of `pose`: bones that stretch
                still do afterwards.
            pose: [B, J, 3], axis-angle, radians.
            corrections: of the B poses.

        Returns:
            The corrected bone transforms [B, J, 4, 4] and poses [B, J, 3].
        """
        centre, turns = self.joints(bone_transforms), bone_turns(bone_transforms)
        change = axis_angle_to_matrix(corrections.turn)
        about_joint = turns @ change @ turns.transpose(-1, -2)  # the same rotation, in the axes of the posed frame
        fixed = centre - (about_joint @ centre[..., None])[..., 0]
        own_moves = torch.zeros_like(bone_transforms)
        own_moves[..., :3, :3], own_moves[..., :3, 3], own_moves[..., 3, 3] = about_joint, fixed, 1
        own_moves[:, [joint for joint, parent in enumerate(self.parents) if parent < 0], :3, 3] += corrections.shift[:, None]
        moves: list[Tensor] = []  # of each bone, with all its ancestors
        for joint, parent in enumerate(self.parents):
            moves.append(own_moves[:, joint] if parent < 0 else moves[parent] @ own_moves[:, joint])
        local = axis_angle_to_matrix(pose) @ self._axes.transpose(-1, -2) @ change @ self._axes
        return torch.stack(moves, 1) @ bone_transforms, matrix_to_axis_angle(local)
