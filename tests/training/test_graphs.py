"""Streams and memory of captures, on stand-ins for what PyTorch has for them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch

from snarfcli.training.graphs import CaptureFailed, StepGraphs
from snarfcli.training.numbers import StepNumbers
from snarfcli.training.schedule import StepKind

KIND = StepKind(bootstraps=False, agrees=False)


class Streams:
    """Streams with a current one, in place of those of torch.cuda, and a capture that cannot end if it has failed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        streams = self

        class Stream:
            def __init__(self, *_: Any) -> None:
                self.waited_for: list[Stream] = []

            def wait_stream(self, other: Stream) -> None:
                self.waited_for.append(other)

        class Graph:
            def __init__(self) -> None:
                self.replays = 0

            def pool(self) -> tuple[int, int]:
                return 0, 1

            def replay(self) -> None:
                self.replays += 1

        class Capture:
            """Like PyTorch's, it does not go back to the stream before if the capture cannot be ended."""

            def __init__(self, graph: Graph, pool: Any = None, stream: Stream | None = None) -> None:
                self.stream = Stream() if stream is None else stream

            def __enter__(self) -> None:
                self.before, streams.current = streams.current, self.stream

            def __exit__(self, error: object, *_: object) -> None:
                if error:
                    raise RuntimeError("CUDA error: operation failed due to a previous error during capture")
                streams.current = self.before

        @contextmanager
        def use(stream: Stream) -> Iterator[None]:
            before, streams.current = streams.current, stream
            try:
                yield
            finally:
                streams.current = before

        self.first = self.current = Stream()
        replaced = {"Stream": Stream, "CUDAGraph": Graph, "graph": Capture, "stream": use}
        replaced |= {"current_stream": lambda *_: self.current, "device": lambda *_: nullcontext()}
        for name, value in replaced.items():
            monkeypatch.setattr(torch.cuda, name, value)


class Step:
    """A step that notes its streams."""

    device = torch.device("cuda", 0)

    def __init__(self, streams: Streams, fails_at: int | None = None) -> None:
        self.streams, self.fails_at = streams, fails_at
        self.seen: list[Any] = []

    def run(self, kind: StepKind) -> StepNumbers:
        self.seen.append(self.streams.current)
        if len(self.seen) == self.fails_at:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")
        return StepNumbers(("total",), torch.zeros(1))


def test_a_step_is_captured_on_the_stream_on_which_it_has_run(monkeypatch):
    streams = Streams(monkeypatch)
    step = Step(streams)
    graphs = StepGraphs(step, lambda: [], lambda: None)
    for _ in range(6):
        graphs.run(KIND)
    assert len(step.seen) == 4  # three, and the capture; then replays
    side = step.seen[0]
    assert all(seen is side for seen in step.seen)
    assert side is not streams.first
    assert streams.current is streams.first
    assert side.waited_for == [streams.first] * 3
    assert streams.first.waited_for == [side] * 3
    assert graphs._graphs[KIND][0].replays == 3


@pytest.mark.parametrize("fails_at", [2, 4])
def test_after_a_failure_the_first_stream_is_current_and_has_waited(monkeypatch, fails_at):
    streams = Streams(monkeypatch)
    step, forgotten = Step(streams, fails_at), []
    graphs = StepGraphs(step, lambda: [], lambda: forgotten.append(1))
    for _ in range(fails_at - 1):
        graphs.run(KIND)
    before = len(forgotten)
    with pytest.raises(CaptureFailed, match="there is not enough memory on the GPU"):
        graphs.run(KIND)
    assert streams.current is streams.first
    assert len(streams.first.waited_for) == min(fails_at, 3)
    assert len(forgotten) > before
