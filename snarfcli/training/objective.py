"""The loss of a training step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.bodies.extent import bone_owners, bone_segments
from snarfcli.deformer import NodeWeights
from snarfcli.draws import Draws
from snarfcli.models.system import FieldSamples, Found
from snarfcli.models.trained_field import TrainedField
from snarfcli.precision import matmul_precision
from snarfcli.training.batches import Batch
from snarfcli.training.losses import joint_weight_targets, occupancy_loss, points_on_bones
from snarfcli.training.made_up_poses import MadeUpPoses
from snarfcli.training.schedule import StepKind
from snarfcli.training.settings import TrainingConfig

__all__ = ["Evaluated", "Objective"]

DrawsFor = Callable[[int], Draws]
"""Random numbers of a step by their purpose, one of those below."""

_BONES, _FAR, _EXTRA, _AGREEMENT = 1, 4, 5, 6  # purposes of random numbers; others are in batches.py and trainer.py
_MADE_UP_POSES = 16  # per step with the loss for them


@dataclass
class Evaluated:
    """The loss of a batch, and what it was computed from."""

    losses: dict[str, Tensor]
    """Weighted parts by name, each []."""
    total: Tensor
    """Their sum, []."""
    field: FieldSamples
    """The field at the points."""
    occupied: Tensor
    """[B, N], bool, the labels."""
    roots: Tensor | None
    """Number of correspondences found, [1], also of those beyond a capacity; None in systems with one for each point."""

    def numbers(self) -> dict[str, Tensor]:
        """Return the losses and counts that are reported, each []."""
        lost = (self.occupied & ~self.field.found).sum() / self.occupied.sum().clamp_min(1)
        counts = self.field.correspondences / max(self.occupied.numel(), 1)
        return self.losses | {
            "total": self.total,
            "inside_without_correspondence": lost,
            "correspondences_per_point": counts,
        }


class Objective:
    """The loss of an avatar's networks in a batch.

    Args:
        avatar: whose model is trained.
        config: settings of the losses.
        poses: [F, J, 3], of the training frames, axis-angle, radians, on the model's device.

    Raises:
        ValueError: `config.joint_target` is unknown.
    """

    def __init__(self, avatar: TrainedField, config: TrainingConfig, poses: Tensor) -> None:
        self.model, self.config = avatar.model, config
        self.bones = bone_segments(avatar.skeleton).to(poses.device)
        self.bone_owners = torch.tensor(bone_owners(avatar.skeleton), device=poses.device)
        # The owner of each point, which one call of repeat_interleave in every step would wait for.
        self._owners = self.bone_owners.repeat_interleave(config.bone_points)
        self.joints = avatar.skeleton.canonical_joints.to(poses.device)
        self.joint_targets = joint_weight_targets(avatar.skeleton.parents, config.joint_target).to(poses.device)
        self.made_up = MadeUpPoses(poses)

    def evaluate(self, batch: Batch, kind: StepKind, draws: DrawsFor, capacity: int | None = None) -> Evaluated:
        """Return the loss of a batch.

        Args:
            batch: points and labels.
            kind: of the step.
            draws: random numbers.
            capacity: maximum number of correspondences. With it all shapes are fixed, and nothing waits for a GPU.
        """
        model, config = self.model, self.config
        weights = model.node_weights()
        if config.far_points:
            batch = self.with_far_points(batch, weights, draws)
        found = model.find(batch.points, batch.bone_transforms, batch.pose, weights, capacity)
        field = model.shape_at(found, batch.pose, config.precision)
        losses = {"occupancy": occupancy_loss(field.logits, batch.occupied, field.found)}
        if kind.bootstraps:
            losses |= self._bootstrap_losses(batch, found, draws)
        if kind.agrees:
            losses |= self._agreement_loss(batch, found, draws, masks=capacity is not None)
        losses |= model.extra_losses(batch.bone_transforms, batch.pose, draws(_EXTRA), config.precision, found)
        total = reduce(torch.add, losses.values())
        return Evaluated(losses, total, field, batch.occupied, found.total)

    def add_gradients(self, evaluated: Evaluated) -> None:
        """Add the gradients of the loss to the parameters."""
        with matmul_precision("medium" if self.config.precision == "bfloat16" else self.config.precision):
            evaluated.total.backward()

    @torch.no_grad()
    def with_far_points(self, batch: Batch, weights: NodeWeights | None, draws: DrawsFor) -> Batch:
        """Append points outside the cubes of the frames of a batch, where nothing is occupied.

        There are no samples outside, so they would not show a part of the shape that every pose moves out of the cube, such as
        one beyond the nose of an animal. A point inside a cube, where its label is unknown, is moved beyond all cells.
        """
        points = self.model.far_points(self.config.far_points, batch.bone_transforms, draws(_FAR), weights)
        if points is None:
            return batch
        lower, upper = batch.cube[:, None, 0], batch.cube[:, None, 1]
        is_far = ((points < lower) | (points > upper)).any(-1, keepdim=True)
        points = torch.where(is_far, points, upper + 10 * (upper - lower))
        occupied = torch.cat([batch.occupied, torch.zeros_like(is_far[..., 0])], 1)
        return replace(batch, points=torch.cat([batch.points, points], 1), occupied=occupied)

    def _bootstrap_losses(self, batch: Batch, found: Found, draws: DrawsFor) -> dict[str, Tensor]:
        """Return the losses that fill the bones and tie the joints to their bones (SNARF Sec. 3.3)."""
        losses, config = {}, self.config
        transforms, pose = batch.bone_transforms, batch.pose
        if config.bone_occupancy_weight > 0:
            points = points_on_bones(self.bones, config.bone_points, draws(_BONES))
            logits = self.model.bone_logits(points, self._owners, transforms, pose, config.precision, found)
            entropy = F.binary_cross_entropy_with_logits(logits, torch.ones_like(logits))
            losses["bone_occupancy"] = config.bone_occupancy_weight * entropy
        if config.joint_weight > 0:
            weights = self.model.joint_weights(self.joints, transforms, pose)
            if weights is not None:
                losses["joint_weight"] = config.joint_weight * F.mse_loss(weights, self.joint_targets.expand_as(weights))
        return losses

    def _agreement_loss(self, batch: Batch, found: Found, draws: DrawsFor, masks: bool) -> dict[str, Tensor]:
        """Return the loss that keeps the shape in poses that no frame shows."""
        config, own = self.config, draws(_AGREEMENT)
        made_up = self.made_up.draw(_MADE_UP_POSES, own)
        loss = self.model.agreement_loss(batch.pose, made_up, config.agreement_points, own, config.precision, found, masks)
        return {} if loss is None else {"agreement": config.agreement_weight * loss}
