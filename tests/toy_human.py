"""A person of capsules with the skeleton of an average adult, a smooth skin and arms that swell where they bend."""

from __future__ import annotations

import torch
from analytic_avatar import AnalyticAvatar
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.motions.reader import average_skeleton

RADIUS = 0.06


class ToyHuman(AnalyticAvatar):
    """Capsules of 6 cm from each of SMPL's joints to its parent."""

    def __init__(self, skeleton: Skeleton | None = None) -> None:
        skeleton = average_skeleton().to(torch.float32) if skeleton is None else skeleton
        joints = skeleton.canonical_joints
        super().__init__(skeleton, CanonicalGrid(joints.amin(0) - 0.15, joints.amax(0) + 0.15), subject="toy")

    def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
        inside = RADIUS - self._distances(points_c).amin(1)
        for name in ("l_elbow", "r_elbow"):
            joint = self.skeleton.names.index(name)
            near = torch.exp(-((points_c - self.skeleton.canonical_joints[joint]).norm(dim=1) ** 2) / 0.1**2)
            inside = inside + 0.015 * torch.sin(pose[joint].sum()) * near
        return 40 * inside

    def skinning_weights(self, points_c: Tensor) -> Tensor:
        distances, joints = self._distances(points_c), self.skeleton.num_joints
        weights = points_c.new_zeros(len(points_c), joints)
        shares = torch.softmax(-(distances**2) / (2 * 0.04**2), dim=1)
        for bone, (parent, _) in enumerate(self.skeleton.bones):  # a bone moves with the joint at its start
            weights[:, parent] += shares[:, bone]
        return weights

    def _distances(self, points: Tensor) -> Tensor:
        """Return the distances [N, bones] of points to the bones."""
        joints = self.skeleton.canonical_joints
        found = []
        for parent, joint in self.skeleton.bones:
            along = joints[joint] - joints[parent]
            share = ((points - joints[parent]) @ along / (along @ along).clamp(min=1e-9)).clamp(0, 1)
            found.append((points - joints[parent] - share[:, None] * along).norm(dim=1))
        return torch.stack(found, 1)
