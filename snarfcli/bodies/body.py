"""SMPL-format bodies: shape blend shapes, pose correctives and linear blend skinning."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from snarfcli.bodies.kinematics import axis_angle_to_matrix, forward_kinematics
from snarfcli.bodies.skeleton import Skeleton, legs_apart_pose
from snarfcli.precision import without_autocast

__all__ = ["Body", "PosedBody"]


@dataclass(frozen=True)
class PosedBody:
    """A body in B poses."""

    vertices: Tensor
    """[B, V, 3], posed vertices, metres."""
    joints: Tensor
    """[B, J, 3], posed joints, metres."""
    posed_from_rest: Tensor
    """[B, J, 4, 4], bone transforms from the shaped rest pose."""


@dataclass(frozen=True, eq=False)
class Body:
    """An SMPL-format body (Loper et al., SMPL, SIGGRAPH Asia 2015, section 3).

    The rest pose is a T-pose, y up, facing +z, left is +x, metres.
    """

    v_template: Tensor
    """[V, 3], vertices of the mean shape in the rest pose."""
    faces: Tensor
    """[F, 3], int64 triangles, outward."""
    weights: Tensor
    """[V, J], linear blend skinning weights, rows sum to 1."""
    parents: tuple[int, ...]
    """J parents, -1 for the root; a parent comes before its children."""
    joint_names: tuple[str, ...]
    """J joint names."""
    joint_regressor: Tensor
    """[J, V], joints of a shaped rest body from its vertices."""
    shapedirs: Tensor
    """[V, 3, S], vertex offsets per unit of each shape parameter (beta)."""
    posedirs: Tensor
    """[V, 3, 9 (J - 1)], vertex offsets per entry of R_j - I, j = 1 .. J - 1, row major; [V, 3, 0] without pose correctives."""

    @property
    def num_joints(self) -> int:
        """J, the number of joints."""
        return len(self.parents)

    @property
    def num_betas(self) -> int:
        """S, the number of shape parameters."""
        return self.shapedirs.shape[-1]

    def to(self, *args: Any, **kwargs: Any) -> Body:
        """Convert every floating tensor as `Tensor.to` does; `faces` only changes device."""
        moved = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), Tensor)}
        moved = {name: value.to(*args, **kwargs) for name, value in moved.items()}
        moved["faces"] = self.faces.to(moved["weights"].device)
        return replace(self, **moved)

    @without_autocast
    def shaped(self, betas: Tensor | np.ndarray | None = None) -> tuple[Tensor, Tensor]:
        """Return the rest pose of one shape.

        Args:
            betas: [S'], shape parameters, S' at most S; the mean shape without them.

        Returns:
            v_shaped: [V, 3], vertices in the rest pose, metres (SMPL Eq. 8).
            joints_rest: [J, 3], joints in the rest pose, metres (SMPL Eq. 10).

        Raises:
            ValueError: betas is not a vector, or is longer than the body has shape parameters.
        """
        v_shaped = self.v_template
        if betas is not None:
            betas = torch.as_tensor(betas).to(v_shaped)
            if betas.ndim != 1 or len(betas) > self.num_betas:
                raise ValueError(f"betas: wanted at most {self.num_betas} values [S], got shape {list(betas.shape)}")
            v_shaped = v_shaped + self.shapedirs[..., : len(betas)] @ betas
        return v_shaped, self.joint_regressor @ v_shaped

    @without_autocast
    def pose(
        self,
        pose: Tensor | np.ndarray,
        betas: Tensor | np.ndarray | None = None,
        translation: Tensor | np.ndarray | None = None,
    ) -> PosedBody:
        """Pose the body (SMPL Eq. 2, 5 and 6): shape, pose correctives, linear blend skinning.

        Args:
            pose: [B, J, 3], axis-angle, radians, global orientation included.
            betas: [S'], shape parameters, the same in every pose; the mean shape without them.
            translation: [B, 3], metres, none by default.

        Returns:
            Vertices, joints and bone transforms, with the dtype and device of the body.

        Raises:
            ValueError: a shape does not match; the message names the argument.
        """
        pose = torch.as_tensor(pose).to(self.v_template)
        if translation is not None:
            translation = torch.as_tensor(translation).to(self.v_template)
        v_shaped, joints_rest = self.shaped(betas)
        joints, posed_from_rest = forward_kinematics(pose, joints_rest, self.parents, translation)
        batch = pose.shape[0]
        v_rest = v_shaped
        if self.posedirs.shape[-1]:
            feature = axis_angle_to_matrix(pose[:, 1:]) - torch.eye(3, dtype=pose.dtype, device=pose.device)
            offsets = feature.reshape(batch, -1) @ self.posedirs.reshape(-1, self.posedirs.shape[-1]).T
            v_rest = v_shaped + offsets.reshape(batch, -1, 3)
        rows = posed_from_rest[:, :, :3].reshape(batch, self.num_joints, 12)
        blended = (self.weights @ rows).reshape(batch, -1, 3, 4)
        vertices = (blended[..., :3] @ v_rest[..., None]).squeeze(-1) + blended[..., 3]
        return PosedBody(vertices, joints, posed_from_rest)

    def skeleton(self, betas: Tensor | np.ndarray | None = None) -> Skeleton:
        """Return the joint tree of one shape, with SNARF's canonical pose: T-pose, legs 30 degrees outwards."""
        joints_rest = self.shaped(betas)[1]
        pose = legs_apart_pose(self.joint_names, joints_rest.dtype).to(joints_rest.device)
        return Skeleton(self.joint_names, self.parents, joints_rest, pose)
