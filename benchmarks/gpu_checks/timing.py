"""Times of work on a device: by events on a GPU, eagerly or replayed from a CUDA graph, and by the clock on a CPU."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from snarfcli.texts import one_line

__all__ = ["Clock", "Timing"]

Work = Callable[[], object]


@dataclass(frozen=True)
class Timing:
    """Milliseconds of repeated calls, or why there are none."""

    ms: tuple[float, ...] = ()
    problem: str = ""

    @property
    def median(self) -> float:
        """The median, milliseconds; NaN if the work failed."""
        return statistics.median(self.ms) if self.ms else float("nan")

    def __str__(self) -> str:
        if not self.ms:
            return f"failed: {self.problem}"
        return f"{self.median:.3f} ({min(self.ms):.3f}-{max(self.ms):.3f})"

    def over(self, other: Timing) -> str:
        """Return how many times as long this takes as another, as text."""
        return f"{self.median / other.median:.1f}" if self.ms and other.ms else "-"


class Clock:
    """Measures on one device. On a CPU nothing is captured, and works run as they are.

    Args:
        device: on which the works run.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def captured(self, work: Work) -> Work:
        """Return a function that replays `work` from a CUDA graph; the work must not wait for the GPU.

        Raises:
            RuntimeError: the work cannot be captured, or memory runs out.
        """
        if self.device.type != "cuda":
            return work
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # a first call loads kernels and fills caches, on a stream that can be captured
            work()
        torch.cuda.current_stream().wait_stream(stream)
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            work()
        return graph.replay

    def in_turns(self, works: Mapping[str, Work], repeats: int, captured: tuple[str, ...] = ()) -> dict[str, Timing]:
        """Return the times of several works, called one after the other again and again.

        A work that fails gets a timing that says why, and the others are measured.

        Args:
            works: by name.
            repeats: timed calls of each, after two to warm up.
            captured: names of the works to replay from a CUDA graph.
        """
        ready: dict[str, Work] = {}
        results: dict[str, Timing] = {}
        for name, work in works.items():
            try:
                ready[name] = self.captured(work) if name in captured else work
                ready[name]()
                self.wait()
            except (RuntimeError, ValueError) as error:
                ready.pop(name, None)
                results[name] = Timing(problem=one_line(error, 120))
        times: dict[str, list[float]] = {name: [] for name in ready}
        for turn in range(repeats + 1):
            marks = {name: self._call(work) for name, work in ready.items()}
            self.wait()
            for name, mark in marks.items():
                if turn:
                    times[name].append(mark())
        return {name: results[name] if name in results else Timing(tuple(times[name])) for name in works}

    def once(self, work: Work) -> float:
        """Return the seconds of one call by the clock, the GPU's work included."""
        self.wait()
        start = time.perf_counter()
        work()
        self.wait()
        return time.perf_counter() - start

    def wait(self) -> None:
        """Wait for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _call(self, work: Work) -> Callable[[], float]:
        """Run the work and return a function that gives its milliseconds once the device is done."""
        if self.device.type != "cuda":
            start = time.perf_counter()
            work()
            ms = 1000 * (time.perf_counter() - start)
            return lambda: ms
        first, last = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        first.record()
        work()
        last.record()
        return lambda: first.elapsed_time(last)
