"""The threads that the native library keeps between calls."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from snarfcli.networks import run_segment_distance


def distances(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    points, segments = torch.rand(20_000, 3, generator=generator), torch.rand(24, 2, 3, generator=generator)
    return run_segment_distance(points, segments)


def test_calls_at_the_same_time_do_not_disturb_each_other():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    wanted = [distances(seed) for seed in range(16)]
    torch.set_num_threads(3)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert all(torch.equal(a, b) for a, b in zip(pool.map(distances, range(16)), wanted, strict=True))
    finally:
        torch.set_num_threads(before)


# The child has none of its parent's threads: it would wait for them for ever if it relied on them.
FORK = """
import os, sys, torch
sys.path.insert(0, sys.argv[1])
from test_threads import distances
torch.set_num_threads(3)
wanted = distances(0)
for _ in range(3):
    child = os.fork()
    if not child:
        torch.set_num_threads(3)
        ok = torch.equal(distances(0), wanted)
        grandchild = os.fork()
        if not grandchild:
            os._exit(0 if torch.equal(distances(0), wanted) else 1)
        ok = ok and os.waitpid(grandchild, 0)[1] == 0
        os._exit(0 if ok else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert torch.equal(distances(0), wanted)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_process_has_threads_of_its_own():
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORK, os.path.dirname(__file__)], capture_output=True, text=True, timeout=100
    )
    assert run.returncode == 0, run.stderr
