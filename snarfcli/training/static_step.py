"""A training step with fixed shapes and without numbers on the host, so that it can be captured in a CUDA graph."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from snarfcli.draws import HashedDraws
from snarfcli.training.batches import FrameBatches
from snarfcli.training.numbers import StepNumbers
from snarfcli.training.objective import Objective
from snarfcli.training.optimizer import AveragedAdam
from snarfcli.training.schedule import StepKind, learning_rate

__all__ = ["Progress", "StaticStep"]


@dataclass(frozen=True)
class Progress:
    """What has become of the steps that were started."""

    step: int
    """Number of steps taken."""
    is_halted: bool
    """Whether the coming step could not be taken, and nothing was done since."""
    is_cut: bool
    """Whether that was since it had more roots than the capacity."""
    loss: float
    """Loss of the step that could not be taken; 0 if there is none."""
    most_roots: int
    """Largest number of roots of a step since `StaticStep.begin`, also of those beyond the capacity."""


class StaticStep:
    """The step of `Trainer` on batches that are drawn on the device.

    The number of the step, the learning rate and what became of the step are tensors, and roots have a capacity. A step that
    has more roots, or whose loss or gradient is not finite, changes nothing but a flag, which halts all steps after it. The
    host may learn of it many steps later, and no step is lost. Losses and gradients are those of the eager step, up to
    rounding.

    Args:
        objective: the loss.
        batches: those that static steps can read.
        optimizer: of the parameters.
    """

    def __init__(self, objective: Objective, batches: FrameBatches, optimizer: AveragedAdam) -> None:
        self._objective, self._batches, self._optimizer = objective, batches, optimizer
        self.device, config = batches.device, batches.config
        rates = [learning_rate(config, step) for step in range(config.steps + 1)]
        self._rates = torch.tensor(rates, dtype=torch.float32, device=self.device)
        self._step = torch.zeros((), dtype=torch.int64, device=self.device)
        self._halted = torch.zeros((), dtype=torch.bool, device=self.device)
        self._cut = torch.zeros_like(self._halted)
        self._loss = torch.zeros((), device=self.device)
        self._most_roots = torch.zeros_like(self._step)
        self.capacity = 0
        """Maximum number of roots of a step."""

    def begin(self, step: int) -> None:
        """Continue with a step; nothing is halted any more, and no roots have been counted."""
        self._step.fill_(step)
        for state in (self._halted, self._cut, self._loss, self._most_roots):
            state.zero_()

    def run(self, kind: StepKind) -> StepNumbers:
        """Take the coming step, or leave it and all further ones out.

        It must be one of the settings' steps, of this kind, and staged. Nothing waits for the device, and nothing is copied to
        or from it.
        """
        draws = partial(HashedDraws, self._batches.seed, self._step)
        evaluated = self._objective.evaluate(self._batches.batch(self._step), kind, draws, self.capacity)
        self._optimizer.zero_gradients()
        self._objective.add_gradients(evaluated)
        with torch.no_grad():
            numbers = StepNumbers.of(evaluated.numbers())
            self._update(evaluated.total.detach(), evaluated.roots)
        return numbers

    def _update(self, loss: Tensor, roots: Tensor | None) -> None:
        """Let the optimiser take the step unless it is halted, cut or not finite, and note which."""
        before = self._halted.clone()
        self._loss.copy_(torch.where(before, self._loss, loss))
        skip = before | ~loss.isfinite()
        if roots is not None:
            is_cut = (roots[0] > self.capacity) & ~before
            self._cut.logical_or_(is_cut)
            skip = skip | is_cut
            self._most_roots.copy_(torch.where(before, self._most_roots, torch.maximum(self._most_roots, roots[0])))
        rate = self._rates.index_select(0, self._step.reshape(1))[0]
        self._halted.copy_(self._optimizer.step_on_device(rate, self._step, skip))
        self._step.add_(~self._halted)

    def progress(self) -> Progress:
        """Return what has become of the steps so far; waits for the device."""
        state = (self._step, self._halted, self._cut, self._loss, self._most_roots)
        step, halted, cut, loss, roots = torch.stack([value.double() for value in state]).tolist()
        return Progress(int(step), bool(halted), bool(cut), loss if halted else 0.0, int(roots))
