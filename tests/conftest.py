"""Threads of the tests, and what needs a GPU.

The folder is on the path (pyproject.toml), so that tests can import the helpers in it.
"""

from __future__ import annotations

import os

# Before torch is imported, as the commands do: OpenMP threads that wait must not occupy the cores that others need.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
import torch

# At most two threads, and not more in all processes of pytest-xdist than there are cores.
_processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
torch.set_num_threads(max(1, min(2, torch.get_num_threads() // _processes)))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that run on a GPU: those with a parameter "cuda", and those that are skipped without a GPU."""
    for item in items:
        parameters = item.callspec.params.values() if isinstance(item, pytest.Function) and hasattr(item, "callspec") else ()
        reasons = [mark.kwargs.get("reason") for mark in item.iter_markers("skipif")]
        if any(value == "cuda" for value in parameters if isinstance(value, str)) or "needs a CUDA device" in reasons:
            item.add_marker(pytest.mark.gpu)
