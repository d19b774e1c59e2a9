"""The state of a training run and its optimiser steps."""

from __future__ import annotations

import logging
import math
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import torch

from snarfcli.draws import Draws, GeneratorDraws, HashedDraws
from snarfcli.errors import UserError, is_out_of_memory
from snarfcli.fitting import PoseRefiner, require_refinable
from snarfcli.models.fast_snarf import FastSnarf
from snarfcli.models.file_tensors import load_state, read_state, read_tensor
from snarfcli.models.trained_field import TrainedField
from snarfcli.precision import PRECISIONS
from snarfcli.samples.store import SampleStore
from snarfcli.texts import one_line
from snarfcli.training.batches import Batch
from snarfcli.training.checkpoints import (
    CHECKPOINT_FORMAT,
    CHECKPOINT_VERSION,
    check_same_settings,
    checked_code,
    checked_seconds,
    checked_step,
    checked_validations,
)
from snarfcli.training.device_steps import DeviceSteps, choose_batches
from snarfcli.training.finishing import averaged, drop_needless, validate
from snarfcli.training.graphs import CaptureFailed
from snarfcli.training.numbers import StepNumbers
from snarfcli.training.objective import Objective
from snarfcli.training.optimizer import AveragedAdam
from snarfcli.training.schedule import is_due, kind_of, learning_rate
from snarfcli.training.settings import TrainingConfig
from snarfcli.versions import recorded_code

__all__ = ["CHECKPOINT_FORMAT", "CHECKPOINT_VERSION", "Diverged", "Trainer"]

log = logging.getLogger(__name__)

_REFINE_FROM = 100  # step; before, the shape may lack whole limbs
_RENEW_POINTS_EVERY = 100  # steps between two updates of the surface that refined poses are matched with
_SETTLE_EVERY = 50  # steps between two looks at what has become of those that run ahead of the host
_POSES_OF_A_REFRESH = 4  # number of training poses from which the searched cells are updated
_REFRESH, _EXTENSION = 2, 3  # purposes of random numbers; others are in objective.py and batches.py


class Diverged(UserError):
    """A loss or gradient is NaN or infinite."""


class Trainer:
    """Train an avatar's networks on the samples of one subject.

    All randomness comes from the seed, the number of the step and PyTorch's generator, whose state is part of a checkpoint: a
    resumed run takes the same steps as an uninterrupted one. On a GPU, atomic additions in varying order, and the eager steps
    with which a resumed run counts roots, make a difference in rounding.

    On a CUDA device, or with `config.graph` "on", steps are static ones (see `StaticStep`) that run ahead of the host. The
    eager step is their readable form, the only one elsewhere, and takes over where a capture fails.

    Args:
        avatar: the avatar to train, on `device`.
        store: processed samples.
        config: settings.
        seed: of the run.
        device: on which to compute.

    Raises:
        ValueError: `config.precision`, `config.joint_target` or `config.graph` is unknown.
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
        self.batches = choose_batches(store, config, seed, device, self.model)
        self.refiner = self._new_refiner() if config.refine_poses else None
        self.objective = Objective(avatar, config, self.batches.poses())
        self.optimizer = AveragedAdam(self.model, config)
        self._ahead: DeviceSteps | None = None  # steps that run ahead of the host
        if self.batches.are_static:
            self._ahead = DeviceSteps(self.objective, self.batches, self.optimizer)
        self.step = 0
        """The coming step. Where steps run ahead of the host it may fall back in `settle`, as steps are taken again."""
        self.seconds = 0.0
        """Time that the steps have taken, in all parts of the run."""
        self.processor_s: float | None = 0.0
        """Processor time of the steps, of all threads and in all parts of the run; None if a part did not record it."""
        self.validations: list[dict[str, float]] = []
        """The validations so far: `step`, `seconds` and `processor_s` of training, and the numbers of `validate`."""
        self.code = recorded_code()  # now, since the files can change while the training runs
        """Version of the code."""
        self.earlier_code: list[dict[str, str]] = []
        """Other versions of the code that took earlier steps; empty ones did not record what they are."""

    def advance(self) -> StepNumbers:
        """Take one step, or start it on a device, and return its losses and counts, which are read when they are asked for.

        Raises:
            Diverged: the loss, or its gradient, is not finite; the step is not taken. Where steps run ahead of the host it is
                raised at most 50 steps later.
        """
        self._maintain_grids()
        if self._ahead is None or not self._ahead.is_ready or self.step >= self.config.steps:
            return self._eager_step()
        try:
            numbers = self._ahead.run(self.step, kind_of(self.config, self.step))
        except CaptureFailed as error:
            why = str(error)
        else:
            self.step += 1
            return (self.settle() or numbers) if self._is_looked_at() else numbers
        # Only here, where the error is gone, and with it all tensors of the step that failed, for which there was no memory.
        log.info("steps are not captured in a CUDA graph from here on: %s", why)
        numbers = self.settle()
        self._ahead = None
        return numbers or self._eager_step()

    def _is_looked_at(self) -> bool:
        """Return whether someone needs to know now which steps were taken."""
        config = self.config
        periods = (_SETTLE_EVERY, config.validate_every, config.checkpoint_every)
        return self.step >= config.steps or any(is_due(self.step, every) for every in periods)

    def settle(self) -> StepNumbers | None:
        """Wait for all steps that were started, and set `step` to the number of those that were taken.

        Returns:
            The numbers of a step that had more roots than there was room for, and that was now taken eagerly; None if all steps
            were taken.

        Raises:
            Diverged: a loss or gradient was not finite.
        """
        progress = None if self._ahead is None else self._ahead.progress()
        if progress is None:
            return None
        self.step = progress.step
        if progress.is_cut:
            return self._eager_step()
        if progress.is_halted:
            self._check_finite("loss", progress.loss)
            self._check_finite("gradient", math.nan)
        return None

    def _eager_step(self) -> StepNumbers:
        """Take one step whose loss is read before the gradient is computed: the readable form of a static step."""
        batch = self.batches.batch(self.step)
        if self.refiner is not None and self.step >= _REFINE_FROM:
            batch = self._with_refined_poses(batch)
        evaluated = self.objective.evaluate(batch, kind_of(self.config, self.step), self._draws)
        self._check_finite("loss", evaluated.total.item())
        self.optimizer.zero_gradients()
        self.objective.add_gradients(evaluated)
        self._check_finite("gradient", self.optimizer.step(self.learning_rate(), self.step))
        self.step += 1
        if self._ahead is not None:
            self._ahead.note_eager_step(0 if evaluated.roots is None else int(evaluated.roots))
        return StepNumbers.of(evaluated.numbers())

    def learning_rate(self) -> float:
        """Return the learning rate of the coming step."""
        return learning_rate(self.config, self.step)

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
        if is_due(self.step, _RENEW_POINTS_EVERY) or self.step == _REFINE_FROM:
            self.refiner.renew_points(self.avatar)
        self.refiner.refine(self.model, batch.frames, self.step, self.config.precision)
        return self.batches.with_poses(batch)

    def _maintain_grids(self) -> None:
        """Let the grids follow the shape, in the steps in which this is due."""
        periods = (self.config.extend_weights_every, self.config.refresh_cells_every)
        if not any(is_due(self.step, every) for every in periods):
            return
        before = self.step
        self.settle()
        if self.step != before:
            return  # it is due later
        poses = partial(self.batches.poses, _POSES_OF_A_REFRESH)
        if is_due(self.step, self.config.extend_weights_every):
            random = np.random.default_rng([self.seed, self.step, _EXTENSION])
            replaced = self.model.extend_weights(poses(random), self.config.precision)
            if replaced is not None:
                self.optimizer.restart(*replaced)
        if is_due(self.step, self.config.refresh_cells_every):
            random = np.random.default_rng([self.seed, self.step, _REFRESH])
            self.model.refresh_cells(poses(random), self.config.precision)
            self.optimizer.follow_growth()
        if self._ahead is not None:
            self._ahead.follow()

    def _check_finite(self, what: str, value: float) -> None:
        """Raise Diverged for a step that would spoil the weights, and that is not taken."""
        if not math.isfinite(value):
            raise Diverged(
                f"diverged: the {what} is {value} at step {self.step}; lower training.learning_rate, now "
                f"{self.config.learning_rate:g}, and start again with overwrite=true"
            )

    def _draws(self, purpose: int) -> Draws:
        """Return the random numbers for one purpose in the coming step."""
        if self.batches.are_static:
            return HashedDraws(self.seed, torch.tensor(self.step, device=self.device), purpose)
        seed = int(np.random.default_rng([self.seed, self.step, purpose]).integers(2**62))
        return GeneratorDraws.seeded(seed, self.device)

    def averaged_avatar(self) -> TrainedField:
        """Return a copy of the avatar with the averaged weights, ready to use."""
        return averaged(self.avatar, self.optimizer.average)

    def finished_avatar(self) -> TrainedField:
        """Return the averaged avatar, its searched cells shrunk to its shape in training poses, without floating pieces."""
        avatar = self.averaged_avatar()
        drop_needless(avatar, self.batches, self.config.precision)
        return avatar

    def validate(self) -> dict[str, float]:
        """Return the IoU of the averaged avatar, uniform and near-surface, and add it to `validations`.

        It is measured on held-back frames of the training sequences and, if the settings say so, out of distribution.
        """
        config = self.config
        found = validate(
            self.averaged_avatar(), self.store, config.validation_frames, self.refiner, config.validation_ood_frames
        )
        self.validations = [one for one in self.validations if one["step"] < self.step]  # a resumed run validates again
        if found:
            processor = {} if self.processor_s is None else {"processor_s": round(self.processor_s, 2)}
            self.validations.append({"step": self.step, "seconds": round(self.seconds, 2)} | processor | found)
        return found

    def state(self) -> dict[str, Any]:
        """Return all state on which the coming steps depend, as plain dicts and tensors; waits for steps that were started.

        Raises:
            Diverged: as `settle`.
        """
        self.settle()
        return {
            "format": CHECKPOINT_FORMAT,
            "version": CHECKPOINT_VERSION,
            "step": self.step,
            "seconds": self.seconds,
            "processor_s": self.processor_s,
            "validations": self.validations,
            "code": [*self.earlier_code, self.code],
            "seed": self.seed,
            "avatar": self.avatar.to_dict(),
            "training": asdict(self.config),
            "random": torch.get_rng_state(),
            "draws_on_device": self._ahead is not None,
            "poses": None if self.refiner is None else self.refiner.state(),
        } | self.optimizer.state()

    def restore(self, state: dict[str, Any], path: str) -> None:
        """Continue from `state`; `path` names the checkpoint in messages.

        Raises:
            UserError: the state has other settings, or does not fit.
        """
        check_same_settings(state, self.avatar.config, self.config, self.seed, path)
        try:
            load_state(self.model, read_state(state["avatar"]["state"]))
            self.optimizer.restore(state)
            if self.refiner is not None:
                self.refiner.restore(state["poses"])
            torch.set_rng_state(read_tensor(state["random"], "random", torch.get_rng_state().shape, torch.uint8))
            self.step = checked_step(state["step"], self.config.steps)
            if self._ahead is not None:
                self._ahead.follow()
            self.seconds = checked_seconds(state.get("seconds", 0.0))
            processor_s = state.get("processor_s")
            self.processor_s = None if processor_s is None else checked_seconds(processor_s)
            self.validations = checked_validations(state.get("validations", []))
            known = checked_code(state.get("code", [{}]))
            self.earlier_code = [one for one in known if one.get("digest") != self.code["digest"]]
            if state.get("draws_on_device", self._ahead is not None) != (self._ahead is not None):
                log.info("other random numbers than before from here on: training.graph or the device has changed")
        except (LookupError, RuntimeError, TypeError, ValueError, AttributeError) as error:
            if is_out_of_memory(error):
                raise
            reason = f"no {error}" if isinstance(error, KeyError) else one_line(error, 300)
            raise UserError(f"{path} does not fit this version ({reason}); start again with overwrite=true") from None
        self.model.train()
