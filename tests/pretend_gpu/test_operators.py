"""Operators with CUDA kernels on the pretend GPU: results, numbers of kernels, and nothing that a CUDA graph forbids."""

from __future__ import annotations

import pytest
from pretend_gpu.run import Report, run_on_pretend_gpu

KERNELS = {
    "encode": 1,
    "encode with gradients": 1 + 2,
    "distance": 1,
    "distance with gradients": 1 + 1,
    "interpolation": 1,
    "variation": 3,
    "variation with gradients": 3 + 1,
}
CODE = """
import torch
from encoding_arrays import encoding_arrays
from pretend_gpu.device import CUDA, watch
from snarfcli.deformer.trilinear import interpolate_nodes
from snarfcli.deformer.variation import variation
from snarfcli.networks import run_encoding, run_segment_distance

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

def compare_with_gradients(name, function, given, wants):
    def with_gradients(*arguments):
        arguments = list(arguments)
        for index in wants:
            arguments[index] = arguments[index].detach().requires_grad_()
        result = function(*arguments)
        return [result, *torch.autograd.grad(result, [arguments[index] for index in wants], result.detach())]

    compare(name, lambda *arguments: [function(*arguments)], given)
    compare(f"{name} with gradients", with_gradients, given)

compare_with_gradients("encode", run_encoding, encoding_arrays(40), [0, 2])
compare_with_gradients("distance", run_segment_distance, [torch.rand(40, 3), torch.rand(5, 2, 3)], [0])
box = [-torch.ones(3), torch.ones(3)]
compare("interpolation", lambda *given: [interpolate_nodes(*given)], [torch.rand(4, 5, 6, 3), torch.randn(40, 3), *box])
weights, used = torch.rand(4, 5, 6, 3), torch.rand(4, 5, 6) < 0.7
compare_with_gradients("variation", lambda *given: variation(*given)[0], [weights, torch.tensor([0.1, 0.2, 0.3]), used], [0])
"""


@pytest.fixture(scope="module", params=[False, True], ids=["kernels of the CPU", "emulated kernels"])
def report(request) -> Report:
    return run_on_pretend_gpu(CODE, emulated=request.param)


@pytest.mark.parametrize("name", KERNELS)
def test_operators_start_as_many_kernels_as_expected_and_never_wait(report, name):
    seen = report[name]
    assert (seen.mixing, seen.waits, seen.copies) == ([], [], [])
    assert seen.kernels == KERNELS[name]
