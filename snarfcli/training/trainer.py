"""The state of a training run and its optimiser steps."""

from __future__ import annotations

import copy
import logging
import math
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial, reduce
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.bodies.extent import bone_owners, bone_segments
from snarfcli.deformer import NodeWeights
from snarfcli.descriptions import DescriptionError, check_plain
from snarfcli.draws import Draws, GeneratorDraws
from snarfcli.errors import UserError, is_out_of_memory
from snarfcli.evaluation.metrics import iou
from snarfcli.fitting import PoseRefiner, require_refinable
from snarfcli.models.fast_snarf import FastSnarf
from snarfcli.models.file_tensors import load_state, read_state, read_tensor
from snarfcli.models.system import Found
from snarfcli.models.trained_field import TrainedField
from snarfcli.precision import PRECISIONS, matmul_precision
from snarfcli.samples.store import SampleStore
from snarfcli.texts import one_line
from snarfcli.training.batches import Batch, load_frames, new_batches
from snarfcli.training.losses import joint_weight_targets, occupancy_loss, points_on_bones
from snarfcli.training.made_up_poses import MadeUpPoses
from snarfcli.training.optimizer import AveragedAdam
from snarfcli.training.settings import TrainingConfig

__all__ = ["CHECKPOINT_FORMAT", "CHECKPOINT_VERSION", "Diverged", "Trainer"]

log = logging.getLogger(__name__)

CHECKPOINT_FORMAT = "snarf-checkpoint"
CHECKPOINT_VERSION = 2

_MADE_UP_POSES = 16  # per step with the loss for them
_STEPS_OF_SUPPORT = 12  # whose inside points show which pieces of the shape belong to the subject
_REFINE_FROM = 100  # step; before, the shape may lack whole limbs
_RENEW_POINTS_EVERY = 100  # steps between two updates of the surface that refined poses are matched with
_POSES_OF_A_REFRESH = 4  # number of training poses from which the searched cells are updated
_POSES_AT_THE_END = 24  # the same for the finished avatar


class Diverged(UserError):
    """A loss or gradient is NaN or infinite."""


class Trainer:
    """Train an avatar's networks on the samples of one subject.

    All randomness comes from the seed, the number of the step and PyTorch's generator, whose state is part of a checkpoint: a
    resumed run takes the same steps as an uninterrupted one.

    Args:
        avatar: the avatar to train, on `device`.
        store: processed samples.
        config: settings.
        seed: of the run.
        device: on which to compute.

    Raises:
        ValueError: `config.precision` or `config.joint_target` is unknown.
    """

    def __init__(
        self, avatar: TrainedField, store: SampleStore, config: TrainingConfig, seed: int, device: torch.device
    ) -> None:
        if config.precision not in PRECISIONS:
            raise ValueError(f"training.precision: wanted one of {', '.join(PRECISIONS)}, got {config.precision!r}")
        if config.refine_poses:
            store = SampleStore(store.folder, store.manifest)  # whose poses may change
        self.avatar, self.store, self.config, self.seed, self.device = avatar, store, config, seed, device
        self.model = avatar.model.to(device)
        self.model.train()
        self.batches = new_batches(store, config, seed, device)
        self.bones = bone_segments(avatar.skeleton).to(device)
        self.bone_owners = torch.tensor(bone_owners(avatar.skeleton), device=device)
        self.joints = avatar.skeleton.canonical_joints.to(device)
        self.joint_targets = joint_weight_targets(avatar.skeleton.parents, config.joint_target).to(device)
        self.refiner = self._new_refiner() if config.refine_poses else None
        self.made_up = MadeUpPoses(self.batches.poses())
        self.optimizer = AveragedAdam(self.model, config)
        self.step = 0
        self.seconds = 0.0
        """Time that the steps have taken, in all parts of the run."""

    def advance(self) -> dict[str, float]:
        """Take one step and return its losses and counts.

        Raises:
            Diverged: the loss, or its gradient, is not finite; the step is not taken.
        """
        self._maintain_grids()
        batch = self.batches.batch(self.step)
        if self.refiner is not None and self.step >= _REFINE_FROM:
            batch = self._with_refined_poses(batch)
        weights = self.model.node_weights()
        if self.config.far_points:
            batch = self._with_far_points(batch, weights)
        found = self.model.find(batch.points, batch.bone_transforms, batch.pose, weights)
        field = self.model.shape_at(found, batch.pose, self.config.precision)
        losses = {"occupancy": occupancy_loss(field.logits, batch.occupied, field.found)}
        if self.step < self.config.bootstrap_steps:
            losses |= self._bootstrap_losses(batch, found)
        if self.config.agreement_weight > 0 and self._is_due(self.config.agreement_every):
            losses |= self._agreement_loss(batch, found)
        losses |= self.model.extra_losses(batch.bone_transforms, batch.pose, self._draws(5), self.config.precision, found)
        total = reduce(torch.add, losses.values())
        self._check_finite("loss", total.item())
        self.optimizer.zero_gradients()
        with matmul_precision("medium" if self.config.precision == "bfloat16" else self.config.precision):
            total.backward()
        self._check_finite("gradient", self.optimizer.step(self.learning_rate(), self.step))
        self.step += 1
        lost = (batch.occupied & ~field.found).sum() / batch.occupied.sum().clamp_min(1)
        numbers = {name: loss.item() for name, loss in losses.items()}
        numbers |= {"total": total.item(), "inside_without_correspondence": lost.item()}
        numbers |= {"correspondences_per_point": field.correspondences / max(batch.occupied.numel(), 1)}
        return numbers

    def _new_refiner(self) -> PoseRefiner:
        """Return the pose refiner of all training sequences, including their held-back frames.

        Raises:
            ValueError: the system has no forward skinning, or the samples are planar.
        """
        require_refinable(self.avatar, self.store, "training.refine_poses")
        return PoseRefiner(self.store.sequences("train"), self.avatar.skeleton, self.device, self.seed)

    def _with_refined_poses(self, batch: Batch) -> Batch:
        """Refine the poses of the frames of a batch, and return the batch with these poses."""
        assert self.refiner is not None
        assert isinstance(self.model, FastSnarf)
        if self._is_due(_RENEW_POINTS_EVERY) or self.step == _REFINE_FROM:
            self.refiner.renew_points(self.avatar)
        self.refiner.refine(self.model, batch.frames, self.step, self.config.precision)
        return self.batches.with_poses(batch)

    def _maintain_grids(self) -> None:
        """Let the grids follow the shape, in the steps in which this is due."""
        poses = partial(self.batches.poses, _POSES_OF_A_REFRESH)
        if self._is_due(self.config.extend_weights_every):
            replaced = self.model.extend_weights(poses(np.random.default_rng([self.seed, self.step, 3])), self.config.precision)
            if replaced is not None:
                self.optimizer.restart(*replaced)
        if self._is_due(self.config.refresh_cells_every):
            self.model.refresh_cells(poses(np.random.default_rng([self.seed, self.step, 2])), self.config.precision)
            self.optimizer.follow_growth()

    def _is_due(self, every: int) -> bool:
        """Return whether the coming step is one of every `every`; 0 is never."""
        return every > 0 and self.step > 0 and self.step % every == 0

    def _check_finite(self, what: str, value: float) -> None:
        """Raise Diverged for a step that would spoil the weights, and that is not taken."""
        if not math.isfinite(value):
            raise Diverged(
                f"diverged: the {what} is {value} at step {self.step}; lower training.learning_rate, now "
                f"{self.config.learning_rate:g}, and start again with overwrite=true"
            )

    def _draws(self, purpose: int) -> Draws:
        """Return the random numbers for one purpose in the coming step."""
        return GeneratorDraws.seeded(self._seed(purpose), self.device)

    def _seed(self, purpose: int) -> int:
        """Return the seed for one purpose in the coming step."""
        return int(np.random.default_rng([self.seed, self.step, purpose]).integers(2**62))

    @torch.no_grad()
    def _with_far_points(self, batch: Batch, weights: NodeWeights | None) -> Batch:
        """Append points outside the cubes of the frames of a batch, where nothing is occupied.

        There are no samples outside, so they would not show a part of the shape that every pose moves out of the cube, such as
        one beyond the nose of an animal. A point inside a cube, where its label is unknown, is moved beyond all cells.
        """
        points = self.model.far_points(self.config.far_points, batch.bone_transforms, self._draws(4), weights)
        if points is None:
            return batch
        lower, upper = batch.cube[:, None, 0], batch.cube[:, None, 1]
        is_far = ((points < lower) | (points > upper)).any(-1, keepdim=True)
        points = torch.where(is_far, points, upper + 10 * (upper - lower))
        occupied = torch.cat([batch.occupied, torch.zeros_like(is_far[..., 0])], 1)
        return replace(batch, points=torch.cat([batch.points, points], 1), occupied=occupied)

    def learning_rate(self) -> float:
        """Return the learning rate of the coming step: linear warm-up, then a cosine down to the final rate."""
        config = self.config
        warm = min(1.0, (self.step + 1) / max(config.warmup_steps, 1))
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, self.step / max(config.steps, 1))))
        return config.learning_rate * warm * (config.final_learning_rate + (1 - config.final_learning_rate) * cosine)

    def _bootstrap_losses(self, batch: Batch, found: Found) -> dict[str, Tensor]:
        """Return the losses that fill the bones and tie the joints to their bones (SNARF Sec. 3.3)."""
        losses, config = {}, self.config
        transforms, pose = batch.bone_transforms, batch.pose
        if config.bone_occupancy_weight > 0:
            points = points_on_bones(self.bones, config.bone_points, self._draws(1))
            owner = self.bone_owners.repeat_interleave(config.bone_points)
            logits = self.model.bone_logits(points, owner, transforms, pose, config.precision, found)
            entropy = F.binary_cross_entropy_with_logits(logits, torch.ones_like(logits))
            losses["bone_occupancy"] = config.bone_occupancy_weight * entropy
        if config.joint_weight > 0:
            weights = self.model.joint_weights(self.joints, transforms, pose)
            if weights is not None:
                losses["joint_weight"] = config.joint_weight * F.mse_loss(weights, self.joint_targets.expand_as(weights))
        return losses

    def _agreement_loss(self, batch: Batch, found: Found) -> dict[str, Tensor]:
        """Return the loss that keeps the shape in poses that no frame shows."""
        draws, config = self._draws(6), self.config
        made_up = self.made_up.draw(_MADE_UP_POSES, draws)
        loss = self.model.agreement_loss(batch.pose, made_up, config.agreement_points, draws, config.precision, found)
        return {} if loss is None else {"agreement": config.agreement_weight * loss}

    def averaged_avatar(self) -> TrainedField:
        """Return a copy of the avatar with the averaged weights, ready to use."""
        avatar = self.avatar.with_model(copy.deepcopy(self.model))
        with torch.no_grad():
            trained = [p for p in avatar.model.parameters() if p.requires_grad]
            for parameter, average in zip(trained, self.optimizer.average, strict=True):
                parameter.copy_(average)
        return avatar.to(self.device)

    def finished_avatar(self) -> TrainedField:
        """Return the averaged avatar, its searched cells shrunk to its shape in training poses, without floating pieces."""
        avatar = self.averaged_avatar()
        poses = self.batches.poses(_POSES_AT_THE_END)
        avatar.model.tighten_cells(poses, self.config.precision)
        with closing(self.batches):
            inside = (self._found_inside(avatar, step) for step in range(_STEPS_OF_SUPPORT))
            dropped = avatar.model.drop_pieces(poses, inside)
        if dropped:
            what = "a piece" if dropped == 1 else f"{dropped} pieces"
            wanted = self.avatar.config.model.components
            why = "no point inside a training mesh needs it; model.components=N keeps the N largest" if wanted is None else ""
            why = why or f"model.components={wanted}"
            log.info("dropped %s of the shape beside the body (%s)", what, why)
        avatar.model.freeze()
        return avatar

    def _found_inside(self, avatar: TrainedField, step: int) -> tuple[Found, Tensor]:
        """Return where the points of a step's batch that are inside the meshes come from, and the poses [B, J, 3] there."""
        batch = self.batches.batch(step)
        nowhere = batch.cube[:, None, 1] + 10 * (batch.cube[:, None, 1] - batch.cube[:, None, 0])  # beyond all cells
        points = torch.where(batch.occupied[..., None], batch.points, nowhere)
        return avatar.find(points, batch.bone_transforms, batch.pose), batch.pose

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return the IoU of the averaged avatar on held-back frames of the training sequences, uniform and near-surface."""
        avatar = self.averaged_avatar()
        frames = [(sequence, int(f)) for sequence in self.store.sequences("train") for f in sequence.val_frames]
        count = min(self.config.validation_frames, len(frames))
        frames = [frames[index] for index in np.linspace(0, len(frames) - 1, count).round().astype(int)]
        if self.refiner is not None:
            self.refiner.refine_all(avatar, frames, desc="validate: refine poses")
        values = []
        for sequence, frame in frames:
            batch = load_frames([(sequence, frame, np.arange(0, sequence.num_points, 2))], self.device)
            inside = avatar.query(batch.points, batch.bone_transforms, batch.pose).logits > 0
            inside, occupied = inside[0].cpu().numpy(), batch.occupied[0].cpu().numpy()
            half = len(inside) // 2
            values.append([iou(inside[:half], occupied[:half]), iou(inside[half:], occupied[half:])])
        if self.refiner is not None:
            self.refiner.poses.forget(frames)  # so that a resumed run, which validates again, has the same poses
        if not values:
            return {}
        bbox, surface = np.mean(values, 0)
        return {"iou_bbox": float(bbox), "iou_surface": float(surface)}

    # ---------------------------------------------------------------- checkpoints
    def state(self) -> dict[str, Any]:
        """Return all state on which the coming steps depend, as plain dicts and tensors."""
        return {
            "format": CHECKPOINT_FORMAT,
            "version": CHECKPOINT_VERSION,
            "step": self.step,
            "seconds": self.seconds,
            "seed": self.seed,
            "avatar": self.avatar.to_dict(),
            "training": asdict(self.config),
            "random": torch.get_rng_state(),
            "poses": None if self.refiner is None else self.refiner.state(),
        } | self.optimizer.state()

    def restore(self, state: dict[str, Any], path: str) -> None:
        """Continue from `state`; `path` names the checkpoint in messages.

        Raises:
            UserError: the state has other settings, or does not fit.
        """
        same = {"workers": self.config.workers}  # the steps do not depend on it
        ours = asdict(self.avatar.config) | {"training": asdict(self.config), "seed": self.seed}
        try:
            theirs = state["avatar"]["config"] | {"training": state["training"] | same, "seed": state["seed"]}
            check_plain(theirs, "settings")
        except (KeyError, TypeError, DescriptionError):
            raise UserError(f"{path} is incomplete; start again with overwrite=true") from None
        changed = _differences(theirs, ours)
        if changed:
            raise UserError(
                f"{path} was made with other settings ({', '.join(changed[:4])}); give the same settings to resume, "
                "overwrite=true to start again, or run=NAME for another folder"
            )
        try:
            load_state(self.model, read_state(state["avatar"]["state"]))
            self.optimizer.restore(state)
            if self.refiner is not None:
                self.refiner.restore(state["poses"])
            torch.set_rng_state(read_tensor(state["random"], "random", torch.get_rng_state().shape, torch.uint8))
            self.step = self._checked_step(state["step"])
            self.seconds = self._checked_seconds(state.get("seconds", 0.0))
        except (LookupError, RuntimeError, TypeError, ValueError, AttributeError) as error:
            if is_out_of_memory(error):
                raise
            reason = f"no {error}" if isinstance(error, KeyError) else one_line(error, 300)
            raise UserError(f"{path} does not fit this version ({reason}); start again with overwrite=true") from None
        self.model.train()

    def _checked_step(self, step: Any) -> int:
        """Return the number of the step in a checkpoint.

        Raises:
            ValueError: it is none of this training.
        """
        if type(step) is not int or not 0 <= step <= self.config.steps:
            raise ValueError(f"step: wanted 0 to {self.config.steps}, got another")
        return step

    def _checked_seconds(self, seconds: Any) -> float:
        """Return the time in a checkpoint; ValueError if it is none."""
        if type(seconds) not in (int, float) or not 0 <= seconds < math.inf:
            raise ValueError("seconds: wanted a number from 0, got another")
        return float(seconds)


def _differences(theirs: Any, ours: Any, prefix: str = "") -> list[str]:
    """Return the dotted names under which two nested dicts differ, with both values."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        names = sorted(set(theirs) | set(ours))
        parts = [_differences(theirs.get(n), ours.get(n), f"{prefix}.{n}" if prefix else n) for n in names]
        return [line for part in parts for line in part]
    return [] if theirs == ours else [one_line(f"{prefix}: {str(theirs)[:60]} there, {ours} here")]
