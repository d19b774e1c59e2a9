"""The CUDA kernels of the total variation of weights, run through the same launches on a GPU, if any, or by an emulation."""

from __future__ import annotations

import ctypes

import pytest
import torch
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler
from torch import Tensor

from snarfcli.deformer.variation import variation, variation_reference
from snarfcli.native import cuda_compile, cuda_variation
from snarfcli.native.cuda_variation import run_total_variation

HAS_GPU = torch.cuda.is_available()
SIZE = torch.tensor([0.1, 0.2, 0.05])


class Runner:
    """Runs the kernels, on the emulation or on a GPU, with arrays on the CPU."""

    def __init__(self, device: str, block: int = 1) -> None:
        self.device, self.block = device, block

    def __call__(self, weights: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
        if self.device == "emulated":
            return run_total_variation(EmulatedGpu(torch.float32, self.block), weights, SIZE, used)
        total, gradient = variation(weights.cuda(), SIZE.cuda(), None if used is None else used.cuda())
        return total.cpu(), gradient.cpu()


@pytest.fixture(params=["emulated", "cuda"] if HAS_GPU else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


def weights_and_used(shape: tuple[int, ...], share: float | None) -> tuple[Tensor, Tensor | None]:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(shape, generator=generator)
    weights[weights < 0.1] = 0.05  # equal neighbours, where the slope is 0
    return weights, None if share is None else torch.rand(shape[:3], generator=generator) < share


# ---------------------------------------------------------------- arguments
def test_structure_and_constant_match_the_kernels():
    require_compiler()
    assert build_emulation(torch.float32).variation_bytes() == ctypes.sizeof(cuda_variation._Variation)
    source = (cuda_compile.cuda_sources() / "cuda" / "variation.cu").read_text()
    assert f"kVariationThreads = {cuda_variation._THREADS};" in source


def test_wrong_arguments_are_named(runner):
    weights = torch.zeros(2, 3, 4, 5)
    for used, got in ((torch.ones(2, 3, 4), "torch.float32 [2, 3, 4]"), (torch.ones(2, 4, 3).bool(), "torch.bool [2, 4, 3]")):
        with pytest.raises(ValueError, match=r"used: wanted bool \[2, 3, 4\], got ") as raised:
            runner(weights, used)
        assert str(raised.value).endswith(got)


def test_too_many_nodes_are_refused():
    with pytest.raises(ValueError, match=r"weights: wanted at most 2\^30 nodes on a GPU, got 1074790400"):
        run_total_variation(EmulatedGpu(torch.float32), torch.zeros(1, 1, 1, 1).expand(1024, 1024, 1025, 1), SIZE, None)


# ---------------------------------------------------------------- results
@pytest.mark.parametrize("shape", [(2, 2, 2, 1), (3, 5, 17, 1), (1, 4, 9, 24), (4, 8, 8, 1), (4, 5, 13, 24), (1, 1, 1, 3)])
@pytest.mark.parametrize("share", [None, 0.0, 0.6, 1.0])
def test_variation_and_gradient_are_those_of_the_reference(runner, shape, share):
    weights, used = weights_and_used(shape, share)
    wide = weights.double().requires_grad_()
    wanted = variation_reference(wide, SIZE, used)
    total, gradient = runner(weights, used)
    torch.testing.assert_close(total.double(), wanted.detach(), rtol=1e-5, atol=0)
    right = torch.autograd.grad(wanted, wide)[0] if wanted.requires_grad else torch.zeros_like(wide)
    torch.testing.assert_close(gradient.double(), right, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("share", [None, 0.6])
def test_the_gradient_has_the_bits_of_the_cpu(runner, share):
    weights, used = weights_and_used((4, 5, 13, 7), share)
    total, gradient = runner(weights, used)
    on_cpu = variation(weights, SIZE, used)
    torch.testing.assert_close(total, on_cpu[0])
    assert torch.equal(gradient, on_cpu[1])


def test_nodes_that_are_not_used_are_not_read(runner):
    weights, used = weights_and_used((3, 5, 7, 4), 0.6)
    wanted = runner(weights, used)
    weights[~used] = torch.nan
    found = runner(weights, used)
    assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))


@pytest.mark.parametrize("shape", [(0, 4, 4, 2), (4, 4, 4, 0)])
def test_without_weights_nothing_changes(runner, shape):
    total, gradient = runner(torch.zeros(shape), None)
    assert total == 0
    assert gradient.shape == shape


def test_variation_of_strided_weights(runner):
    weights, used = weights_and_used((4, 5, 6, 3), 0.7)
    strided, turned = (one.transpose(0, 2).contiguous().transpose(0, 2) for one in (weights, used))
    assert not strided.is_contiguous()
    for found, wanted in zip(runner(strided, turned), runner(weights, used), strict=True):
        assert torch.equal(found, wanted)


# ---------------------------------------------------------------- launches
@pytest.mark.parametrize("block", [2, 7, 64])
def test_the_number_of_threads_changes_no_gradient(block):
    require_compiler()
    for share in (None, 0.6):
        weights, used = weights_and_used((3, 4, 7, 5), share)
        one, many = Runner("emulated")(weights, used), Runner("emulated", block)(weights, used)
        torch.testing.assert_close(one[0], many[0])  # summed in another order
        assert torch.equal(one[1], many[1])


def test_blocks_take_turns_when_there_are_many_weights(runner, monkeypatch):
    weights, used = weights_and_used((3, 4, 50, 5), 0.6)
    wanted = runner(weights, used)
    monkeypatch.setattr(cuda_variation, "_CHANGE_BLOCKS", 3)
    monkeypatch.setattr(cuda_variation, "_PAIR_BLOCKS", 2)
    found = runner(weights, used)
    torch.testing.assert_close(found[0], wanted[0])
    assert torch.equal(found[1], wanted[1])


def test_pairs_are_counted_only_where_nodes_are_left_out():
    require_compiler()
    for share, launches in ((0.5, 3), (None, 2)):
        emulated = EmulatedGpu(torch.float32)
        weights, used = weights_and_used((2, 3, 4, 5), share)
        run_total_variation(emulated, weights, SIZE, used)
        assert emulated.launches == ["count_pairs", "measure_changes", "sum_changes"][-launches:]
