"""What torch.cuda answers about the pretend device."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import torch
from pretend_gpu.graphs import PretendCapture, PretendGraph, is_capturing

__all__ = ["install"]

_CAPABILITY = (9, 0)
_BYTES = 80 * 2**30
_PROPERTIES = SimpleNamespace(
    name="pretend GPU", major=_CAPABILITY[0], minor=_CAPABILITY[1], total_memory=_BYTES, multi_processor_count=132
)


def install(note_wait: Callable[[str], None]) -> None:
    """Replace the functions of torch.cuda; `note_wait` is told of those that wait for the device."""

    def synchronize(*_: Any) -> None:
        note_wait("torch.cuda.synchronize")

    class Event:
        """A mark in the stream of the device, which has done everything already."""

        def __init__(self, **_: Any) -> None: ...

        def record(self, *_: Any) -> None: ...

        def wait(self, *_: Any) -> None: ...

        def query(self) -> bool:
            return True

        def synchronize(self) -> None:
            note_wait("torch.cuda.Event.synchronize")

        def elapsed_time(self, other: Event) -> float:
            return 0.0

    class Stream:
        """The only stream of the device."""

        cuda_stream = 0

        def __init__(self, *_: Any, **__: Any) -> None: ...

        def wait_stream(self, *_: Any) -> None: ...

        def wait_event(self, *_: Any) -> None: ...

        def record_event(self, *_: Any) -> Event:
            return Event()

        def query(self) -> bool:
            return True

        def synchronize(self) -> None:
            note_wait("torch.cuda.Stream.synchronize")

    answers = {
        "_lazy_init": None, "is_available": True, "is_initialized": True, "device_count": 1, "current_device": 0,
        "get_device_name": _PROPERTIES.name, "get_device_capability": _CAPABILITY, "get_device_properties": _PROPERTIES,
        "is_bf16_supported": True, "empty_cache": None, "memory_allocated": 0, "max_memory_allocated": 0,
        "reset_peak_memory_stats": None, "mem_get_info": (_BYTES, _BYTES), "graph_pool_handle": (0, 1),
    }  # fmt: skip
    for name, answer in answers.items():
        setattr(torch.cuda, name, _answers(answer))
    replaced = {
        "synchronize": synchronize, "Event": Event, "Stream": Stream, "CUDAGraph": PretendGraph,
        "graph": PretendCapture, "is_current_stream_capturing": is_capturing,
    }  # fmt: skip
    for name, value in replaced.items():
        setattr(torch.cuda, name, value)
    for name in ("current_stream", "default_stream"):
        setattr(torch.cuda, name, lambda *_: Stream())
    for name in ("device", "device_of", "stream"):
        setattr(torch.cuda, name, lambda *_: nullcontext())


def _answers(answer: Any) -> Callable[..., Any]:
    return lambda *_, **__: answer
