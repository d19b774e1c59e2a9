"""Training steps that run ahead of the host on a device: whether a training can have them, and how many roots they keep."""

from __future__ import annotations

import logging
import math

import torch

from snarfcli.errors import is_out_of_memory
from snarfcli.models.system import System
from snarfcli.native import backend
from snarfcli.samples.store import SampleStore
from snarfcli.training.batches import FrameBatches, new_batches
from snarfcli.training.device_batches import DeviceBatches
from snarfcli.training.graphs import StepGraphs
from snarfcli.training.numbers import StepNumbers
from snarfcli.training.objective import Objective
from snarfcli.training.optimizer import AveragedAdam
from snarfcli.training.schedule import StepKind
from snarfcli.training.settings import TrainingConfig
from snarfcli.training.staged_batches import StagedBatches
from snarfcli.training.static_step import Progress, StaticStep

__all__ = ["GRAPHS", "DeviceSteps", "choose_batches"]

log = logging.getLogger(__name__)

GRAPHS = ("auto", "on", "off")
"""Values of `TrainingConfig.graph`."""

_MEASURED_STEPS = 2  # eager steps, which count the roots, before the first static one
_ROOM = 1.25  # capacity as a multiple of the largest number of roots
_LEAST_ROOM = 1.1  # below this the capacity grows before a step is cut
_ROUND = 256  # multiple of roots


class DeviceSteps:
    """Static steps, captured where there is CUDA, and the capacity of their roots.

    Args:
        objective: the loss.
        batches: those that static steps can read.
        optimizer: of the parameters.
    """

    def __init__(self, objective: Objective, batches: FrameBatches, optimizer: AveragedAdam) -> None:
        self._model, self._optimizer, self._batches = objective.model, optimizer, batches
        self._static = StaticStep(objective, batches, optimizer)
        self._graphs = StepGraphs(self._static, self._tensors, optimizer.zero_gradients)
        self._next: int | None = None  # step that the device takes next, as far as the host knows; None if it must be told
        self._measured = 0
        self._most_roots = 0
        self._model.keep_room()

    def _tensors(self) -> list[torch.Tensor]:
        return [*self._model.parameters(), *self._model.buffers(), *self._optimizer.tensors()]

    @property
    def is_ready(self) -> bool:
        """Whether enough eager steps have told the number of roots."""
        return self._measured >= _MEASURED_STEPS

    def note_eager_step(self, roots: int) -> None:
        """Note the number of roots of an eager step, which may be more than the capacity."""
        self._measured += 1
        self._most_roots = max(self._most_roots, roots)
        self._next = None
        self._fit()

    def follow(self) -> None:
        """Follow changes of the model between two steps, and let the capacity shrink to the roots since the last change."""
        self._fit(may_shrink=True)
        self._most_roots, self._next = 0, None

    def run(self, step: int, kind: StepKind) -> StepNumbers:
        """Start a step. Its numbers are those of no step if a step before it is found to have halted the device.

        Raises:
            CaptureFailed: it could not be captured, and was not started.
        """
        if self._next != step:  # something has happened since the last step
            self._graphs.follow()
            self._static.begin(step)
        self._batches.stage(step)
        numbers = self._graphs.run(kind)
        self._next = step + 1
        return numbers

    def progress(self) -> Progress | None:
        """Return what has become of the steps that were started, for which it waits; None if there are none."""
        if self._next is None:
            return None
        progress = self._static.progress()
        self._most_roots = max(self._most_roots, progress.most_roots)
        if progress.is_halted:
            self._next = None
        return progress

    def _fit(self, may_shrink: bool = False) -> None:
        """Change the capacity if it is too small for the roots, or more than twice of what they need."""
        wanted = _ROUND * max(1, math.ceil(_ROOM * self._most_roots / _ROUND))
        capacity = self._static.capacity
        if self._most_roots * _LEAST_ROOM > capacity or (may_shrink and self._most_roots and 2 * wanted < capacity):
            self._static.capacity = wanted
            self._graphs.drop()


def choose_batches(store: SampleStore, config: TrainingConfig, seed: int, device: torch.device, model: System) -> FrameBatches:
    """Return batches for static steps if the steps of a training can have fixed shapes and should, otherwise ordinary ones.

    One line of the log says why steps are not captured that were to be.

    Raises:
        ValueError: `config.graph` is unknown.
    """
    if config.graph not in GRAPHS:
        raise ValueError(f"training.graph: wanted {', '.join(GRAPHS[:-1])} or {GRAPHS[-1]}, got {config.graph!r}")
    wants = config.graph == "on" or (config.graph == "auto" and device.type == "cuda")
    why_not = _why_no_fixed_shapes(config, model, device) if wants else None
    if not wants or why_not:
        if why_not:
            log.info("the training step is not captured in a CUDA graph: %s", why_not)
        return new_batches(store, config, seed, device)
    try:
        batches = (StagedBatches if config.fresh_points else DeviceBatches)(store, config, seed, device)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        log.info("the training step is not captured in a CUDA graph: %s has no memory for the samples", device)
        return new_batches(store, config, seed, device)
    if device.type != "cuda":
        log.info("training.graph=on: steps have fixed shapes, and are not captured, since there is no CUDA device")
    return batches


def _why_no_fixed_shapes(config: TrainingConfig, model: System, device: torch.device) -> str | None:
    """Return why the steps of a training cannot have fixed shapes on the device, or None if they can."""
    if config.refine_poses:
        return "training.refine_poses=true changes the samples in every step"
    if not model.has_fixed_shapes:
        return "a search in the weight field itself, as of model=snarf, has as many results as it finds"
    if model.search is not None and device.type == "cuda":
        reason = "search.backend=reference" if model.search.backend == "reference" else backend.why_no_kernels(device)
        return None if reason is None else f"the search in PyTorch waits for the GPU ({reason})"
    return None
