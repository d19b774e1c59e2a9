"""CUDA graphs on the pretend device: the operators and kernels of a capture, which a replay runs again in the same memory.

As on a GPU, a capture only records: when it ends, no tensor from before has changed, and the new ones hold nothing of use. A
replay reads what is in the captured tensors at that time, writes its results into the tensors that the capture returned, and
repeats all values of the host as they were. Waiting and copies from pageable memory are errors in a capture.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pretend_gpu import seen
from torch import Tensor, UntypedStorage
from torch.utils._pytree import tree_leaves

__all__ = ["PretendCapture", "PretendGraph", "is_capturing", "record"]

_captures: list[PretendGraph] = []  # at most one


@dataclass
class _Call:
    """One operator or kernel, on tensors of the CPU."""

    run: Callable[[], Any]
    """Computes it again, from the tensors of the capture."""
    results: dict[int, Tensor]
    """The tensors that the capture's call has made, by their places in its result."""
    launches: int
    """Number of kernels."""
    line: str
    """What it is, and what called it."""


class PretendGraph:
    """In place of torch.cuda.CUDAGraph."""

    def __init__(self, keep_graph: bool = False) -> None:
        self._calls: list[_Call] = []
        self._before: list[tuple[UntypedStorage, UntypedStorage]] = []

    def capture_begin(self, *_: Any, **__: Any) -> None:
        if _captures:
            raise RuntimeError("CUDA error: a capture is in progress already")
        _captures.append(self)
        self._calls = []
        memory = {_memory(tensor): tensor.untyped_storage() for tensor in _all_tensors()}
        self._before = [(storage, storage.clone()) for storage in memory.values()]

    def capture_end(self) -> None:
        _captures.remove(self)
        for storage, before in self._before:
            storage.copy_(before)
        for tensor in (tensor for call in self._calls for tensor in call.results.values()):
            tensor.fill_(math.nan if tensor.is_floating_point() else 0)

    def replay(self) -> None:
        """Run all calls of the capture again; for a `watch`, their kernels are like all others."""
        if is_capturing():
            raise RuntimeError("CUDA error: a graph cannot be replayed while another is captured")
        for call in self._calls:
            again = tree_leaves(call.run())
            for place, old in call.results.items():
                if again[place].shape != old.shape:
                    raise RuntimeError(f"a captured operator has a result of another size in a replay: {call.line}")
                old.copy_(again[place])
            seen.note_kernels(call.line, call.launches)

    def reset(self) -> None:
        self._calls = []

    def pool(self) -> tuple[int, int]:
        return 0, 1


class PretendCapture:
    """In place of torch.cuda.graph: what is inside `with` becomes part of a graph."""

    def __init__(self, cuda_graph: PretendGraph, *_: Any, **__: Any) -> None:
        self._graph = cuda_graph

    def __enter__(self) -> None:
        self._graph.capture_begin()

    def __exit__(self, *_: object) -> None:
        self._graph.capture_end()


def is_capturing() -> bool:
    """Return whether a capture is in progress."""
    return bool(_captures)


def record(run: Callable[[], Any], given: Any, result: Any, launches: int, line: str) -> None:
    """Make a call part of the capture, if one is in progress.

    Args:
        run: computes it again, from tensors of the CPU.
        given: its arguments. Tensors in `result` that share memory with them are views, or were changed in place.
        result: of the call in the capture.
        launches: number of its kernels.
        line: what it is, and what called it.
    """
    if _captures:
        memory = {_memory(leaf) for leaf in tree_leaves(given) if isinstance(leaf, Tensor)}
        leaves = enumerate(tree_leaves(result))
        made = {place: leaf for place, leaf in leaves if isinstance(leaf, Tensor) and _memory(leaf) not in memory}
        _captures[-1]._calls.append(_Call(run, made, launches, line))


def _all_tensors() -> list[Tensor]:
    """Return the tensors of the CPU behind all that are on the device now."""
    from pretend_gpu.device import PretendTensor

    return [thing.inner for thing in gc.get_objects() if type(thing) is PretendTensor]


def _memory(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata
