"""A static step captured in CUDA graphs, one for each kind of step.

PyTorch's rules for a capture are kept: the step has run before on a side stream, gradients are made inside the graph, and no
address that the graph reads changes between replays.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from snarfcli.errors import is_out_of_memory
from snarfcli.texts import one_line
from snarfcli.training.numbers import StepNumbers
from snarfcli.training.schedule import StepKind
from snarfcli.training.static_step import StaticStep

__all__ = ["CaptureFailed", "StepGraphs"]

log = logging.getLogger(__name__)

_WARM_UP_STEPS = 3  # on a side stream before a capture: libraries choose their algorithms, kernels are loaded


class CaptureFailed(Exception):
    """A step could not be captured; the message says why, in one line."""


class StepGraphs:
    """Takes static steps: uncaptured at first, as true steps of the training, then as replays of a graph.

    On a device without CUDA all steps are uncaptured.

    Args:
        step: the step.
        tensors: returns what the step reads and changes and may be replaced, such as parameters and buffers; a graph is
            dropped when one of them is another tensor than at its capture.
        forget_gradients: called before and after a capture, so that gradients belong to the graph alone.
    """

    def __init__(self, step: StaticStep, tensors: Callable[[], Sequence[Tensor]], forget_gradients: Callable[[], None]) -> None:
        self._step, self._tensors, self._forget_gradients = step, tensors, forget_gradients
        self._is_cuda = step.device.type == "cuda"
        self._known: list[Tensor] = []
        self._warm: dict[StepKind, int] = {}
        self._graphs: dict[StepKind, tuple[torch.cuda.CUDAGraph, StepNumbers]] = {}
        self._side: torch.cuda.Stream | None = None

    def drop(self) -> None:
        """Forget all graphs, and the gradients that belong to them: what they read may be elsewhere."""
        self._forget_gradients()
        self._graphs.clear()
        self._warm.clear()
        self._known = []

    def follow(self) -> None:
        """Drop the graphs if a tensor that they read has been replaced; called after changes between steps."""
        now = list(self._tensors())
        if len(now) != len(self._known) or any(one is not other for one, other in zip(now, self._known, strict=True)):
            self.drop()
            self._known = now

    def run(self, kind: StepKind) -> StepNumbers:
        """Take a step of one kind; does not wait for the device, except in a capture.

        Raises:
            CaptureFailed: the step could not be captured. It was not taken.
        """
        if not self._is_cuda:
            return self._step.run(kind)
        if kind not in self._graphs:
            try:
                if self._warm.get(kind, 0) < _WARM_UP_STEPS:
                    self._warm[kind] = self._warm.get(kind, 0) + 1
                    return self._run_aside(kind)
                self._graphs[kind] = self._capture(kind)
            except RuntimeError as error:
                self.drop()
                raise CaptureFailed(_reason(error)) from error
        graph, numbers = self._graphs[kind]
        graph.replay()
        return StepNumbers(numbers.names, numbers.values_on_device.clone())  # the next replay overwrites them

    def _run_aside(self, kind: StepKind) -> StepNumbers:
        """Take a step on the side stream."""
        side, current = self._side_stream(), torch.cuda.current_stream(self._step.device)
        side.wait_stream(current)
        try:
            with torch.cuda.stream(side):
                numbers = self._step.run(kind)
                self._forget_gradients()
        finally:
            current.wait_stream(side)  # also if only a part of the step was launched
        return numbers

    def _capture(self, kind: StepKind) -> tuple[torch.cuda.CUDAGraph, StepNumbers]:
        """Capture a step, which takes none, in a graph; all graphs share their memory, as none needs another's results."""
        graph, side = torch.cuda.CUDAGraph(), self._side_stream()
        pool = next(iter(self._graphs.values()))[0].pool() if self._graphs else None
        self._forget_gradients()
        gc.collect()  # a graph of autograd that is still there from an eager step would tie the capture to another stream
        # On the stream of the steps before, for which cuBLAS has its workspaces. PyTorch's context manager alone would leave it
        # as the current stream after a capture that failed.
        with torch.cuda.device(self._step.device), torch.cuda.stream(side), torch.cuda.graph(graph, pool=pool, stream=side):
            numbers = self._step.run(kind)
        self._forget_gradients()
        log.debug("captured a step: %s", kind)
        return graph, numbers

    def _side_stream(self) -> torch.cuda.Stream:
        if self._side is None:
            self._side = torch.cuda.Stream(self._step.device)
        return self._side


def _reason(error: RuntimeError) -> str:
    """Return why a step failed, in one line; after running out of memory the end of a capture may fail as well."""
    causes = (error, error.__context__ or error)
    return "there is not enough memory on the GPU" if any(map(is_out_of_memory, causes)) else one_line(error, 200)
