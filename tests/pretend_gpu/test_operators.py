"""Operators with CUDA kernels on the pretend GPU: results, numbers of kernels, and nothing that a CUDA graph forbids."""

from __future__ import annotations

import pytest
from pretend_gpu.run import Report, run_on_pretend_gpu

KERNELS = {"encode": 1, "encode with gradients": 1 + 2}
CODE = """
import torch
from encoding_arrays import encoding_arrays
from pretend_gpu.device import CUDA, watch
from snarfcli.networks import run_encoding

def compare(name, function, given):
    \"\"\"Compare results on the device and on the CPU, also those of a graph.\"\"\"
    wanted = function(*given)
    moved = [one.to(CUDA) if isinstance(one, torch.Tensor) else one for one in given]
    function(*moved)  # keeps constants on the device
    with watch(name):
        found = function(*moved)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = function(*moved)
    graph.replay()
    for results in (found, captured):
        for one, other in zip(results, wanted, strict=True):
            assert one.device == CUDA and one.shape == other.shape
            torch.testing.assert_close(one.detach().cpu(), other.detach(), rtol=1e-4, atol=1e-4)

def encode(*given):
    return [run_encoding(*given)]

def encode_with_gradients(points, frequencies, table, *rest):
    points, table = points.detach().requires_grad_(), table.detach().requires_grad_()
    encoded = run_encoding(points, frequencies, table, *rest)
    return [encoded, *torch.autograd.grad(encoded, [points, table], encoded.detach())]

compare("encode", encode, encoding_arrays(40))
compare("encode with gradients", encode_with_gradients, encoding_arrays(40))
"""


@pytest.fixture(scope="module", params=[False, True], ids=["kernels of the CPU", "emulated kernels"])
def report(request) -> Report:
    return run_on_pretend_gpu(CODE, emulated=request.param)


@pytest.mark.parametrize("name", KERNELS)
def test_operators_start_as_many_kernels_as_expected_and_never_wait(report, name):
    seen = report[name]
    assert (seen.mixing, seen.waits, seen.copies) == ([], [], [])
    assert seen.kernels == KERNELS[name]
