"""The kernel of random bits, compiled as C++, against PyTorch; and on a GPU where there is one."""

from __future__ import annotations

import pytest
import torch
from cuda_emulation import EmulatedGpu, host_compiler

from snarfcli.draws import random_bits
from snarfcli.native.cuda_draws import run_random_bits


@pytest.mark.skipif(host_compiler() is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("block", [1, 7])
@pytest.mark.parametrize("count", [0, 1, 6, 7, 8, 100])
def test_the_kernel_draws_what_pytorch_does(count, block):
    for step, key in ((0, 0), (44_999, 2**32 - 1), (2**32 - 1, 12345)):
        bits = run_random_bits(EmulatedGpu(torch.float32, block), torch.tensor(step), key, count)
        assert torch.equal(bits, random_bits(torch.tensor(step), key, count))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_draws_what_the_cpu_does():
    here, there = (random_bits(torch.tensor(7, device=device), 12345, 10_000) for device in ("cpu", "cuda"))
    assert torch.equal(here, there.cpu())
