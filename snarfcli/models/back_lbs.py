"""Back-LBS: backward skinning by weights of the posed point (SNARF Sec. 4.2, Fast-SNARF Sec. 5.1.2)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.bodies.extent import weight_segments
from snarfcli.deformer import BonePrior, CanonicalGrid
from snarfcli.deformer.hierarchy import make_softmax
from snarfcli.models.pointwise import PointwiseSystem, PosedNetwork, into_root_frame, invert_blended, move_with_bones
from snarfcli.models.system import Found, pose_angles
from snarfcli.shape import CONDITIONS

__all__ = ["BackLBS"]


class BackLBS(PointwiseSystem):
    """A network of the posed point and the pose predicts skinning weights, whose blended transform is inverted.

    All else is as in forward skinning: canonical shape, losses, size and sharpness of the skinning network. With
    `skinning.prior_falloff_m` the weights start from the distances to the posed bones; in forward skinning they start from
    those to the canonical bones.

    Arguments: as `PointwiseSystem`.
    """

    conditions: ClassVar[tuple[str, ...]] = CONDITIONS

    def _build(self, skeleton: Skeleton, grid: CanonicalGrid, template: MeshTemplate | None) -> None:
        skinning, joints = self.config.skinning, skeleton.num_joints
        self.softmax = make_softmax(skinning.softmax, joints, skeleton.parents)
        falloff = skinning.prior_falloff_m
        self.prior = None if falloff is None else BonePrior(*weight_segments(skeleton, continued=True), joints, falloff)
        scale = float((grid.upper - grid.lower).max()) / 2
        self.weight_network = PosedNetwork(
            3 * (joints - 1), self.softmax.num_logits, self.config, scale, starts_at_zero=falloff is not None
        )

    def posed_weights(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> Tensor:
        """Return the skinning weights [B, N, J] of posed points [B, N, 3]."""
        logits = self.config.skinning.sharpness * self.weight_network(
            into_root_frame(points, bone_transforms), pose_angles(pose)
        )
        if self.prior is not None:
            moved = bone_transforms[:, self.prior.owner]
            ends = torch.einsum("bsrc,sec->bser", moved[..., :3, :3], self.prior.segments) + moved[:, :, None, :3, 3]
            prior = torch.stack([self.prior(part, segments) for part, segments in zip(points, ends, strict=True)])
            logits = logits + self.softmax.invert(prior.flatten(0, 1)).unflatten(0, prior.shape[:2])
        return self.softmax(logits.flatten(0, 1)).unflatten(0, points.shape[:2])

    def canonical_points(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        weights = self.posed_weights(points, bone_transforms, pose)
        return invert_blended(points, weights, bone_transforms), weights

    def bone_logits(
        self,
        points: Tensor,
        owner: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        precision: str = "highest",
        found: Found | None = None,
    ) -> Tensor:
        # Canonical points have no weights here, but points of a bone move with it, which gives their weights.
        index = torch.arange(len(points), device=points.device) % len(pose)
        weights = F.one_hot(owner, self.num_bones).to(points)
        return self.canonical_logits(points, self.condition(pose), index, precision, weights)

    def joint_weights(self, joints: Tensor, bone_transforms: Tensor, pose: Tensor) -> Tensor:
        """Return the weights at the posed joints, [B, J, J]."""
        posed = move_with_bones(joints, torch.arange(len(joints), device=joints.device), bone_transforms)
        return self.posed_weights(posed, bone_transforms, pose)
