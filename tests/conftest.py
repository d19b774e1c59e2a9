"""Threads of the tests. The folder is on the path (pyproject.toml), so that tests can import the helpers in it."""

from __future__ import annotations

import os

# Before torch is imported, as the commands do: OpenMP threads that wait must not occupy the cores that others need.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

# At most two threads, and not more in all processes of pytest-xdist than there are cores.
_processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
torch.set_num_threads(max(1, min(2, torch.get_num_threads() // _processes)))
