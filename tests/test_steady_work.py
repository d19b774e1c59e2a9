"""Memory and open files do not grow with the work: the short form of `tools/trust_memory.py`."""

from __future__ import annotations

import gc
import logging
import os
import tracemalloc
from pathlib import Path

import pytest
import torch
from steady_work import WORK, count_handles

TIMES = {"preprocess": 6, "animate": 12, "occupancy": 60, "mesh": 40, "search": 60, "load": 10}
# Bytes, in the second half of the work: Python keeps some objects for reuse, measured up to 12 kB. A picture of the animation
# has 12 kB, a mesh 20 kB.
MOST_GROWTH = 50_000


@pytest.mark.skipif(os.name != "posix", reason="counts open files as on Unix")
@pytest.mark.parametrize("name", TIMES)
def test_open_files_and_objects_do_not_grow(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL, "snarfcli")  # caplog keeps the lines
    work, count = WORK[name][0], TIMES[name]
    handles: list[int] = []
    objects: list[int] = []
    tensors: list[int] = []

    def tick() -> None:
        handles.append(count_handles())
        if len(handles) in (count // 2, count):
            gc.collect()
            objects.append(tracemalloc.get_traced_memory()[0])
            tensors.append(sum(issubclass(type(one), torch.Tensor) for one in gc.get_objects()))

    work(1, tmp_path, lambda: None)  # imports, and what is kept once
    before = count_handles()
    (tmp_path / "again").mkdir()
    tracemalloc.start()
    try:
        work(count, tmp_path / "again", tick)
    finally:
        tracemalloc.stop()
    assert len(handles) == count
    assert count_handles() <= before
    assert max(handles[count // 2 :]) <= max(handles[: count // 2 + 1])
    assert objects[1] - objects[0] < MOST_GROWTH
    assert tensors[1] <= tensors[0]
