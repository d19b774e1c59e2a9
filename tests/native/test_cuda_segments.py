"""The CUDA kernel of distances to segments, run through the same launch on a GPU, if there is one, or by an emulation."""

from __future__ import annotations

import ctypes

import pytest
import torch
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler
from torch import Tensor

from snarfcli.native import cuda_compile, cuda_segments
from snarfcli.native.cuda_segments import run_segment_distances
from snarfcli.networks.capsules import nearest_segment
from snarfcli.segments import distance_to_segments

HAS_GPU = torch.cuda.is_available()
BLOCK = cuda_segments._THREADS


class Runner:
    """Runs the kernel, on the emulation or on a GPU, with arrays on the CPU."""

    def __init__(self, device: str, block: int = 1) -> None:
        self.device, self.block = device, block

    def __call__(self, points: Tensor, segments: Tensor) -> tuple[Tensor, Tensor]:
        if self.device == "emulated":
            return run_segment_distances(EmulatedGpu(torch.float32, self.block), points, segments)
        distance, direction = nearest_segment(points.cuda(), segments.cuda())
        return distance.cpu(), direction.cpu()


@pytest.fixture(params=["emulated", "cuda"] if HAS_GPU else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


def points_and_segments(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    segments = torch.rand(9, 2, 3, generator=generator)
    segments[3, 1] = segments[3, 0]  # a point
    return 2 * torch.rand(count, 3, generator=generator) - 0.5, segments


def test_structure_and_constant_match_the_kernel():
    require_compiler()
    assert build_emulation(torch.float32).segment_bytes() == ctypes.sizeof(cuda_segments._Distance)
    source = (cuda_compile.cuda_sources() / "cuda" / "segments.cu").read_text()
    assert f"__launch_bounds__({BLOCK})" in source


def test_there_has_to_be_a_segment(runner):
    with pytest.raises(ValueError, match="segments: wanted at least one, got none"):
        runner(torch.zeros(2, 3), torch.zeros(0, 2, 3))


@pytest.mark.parametrize("count", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1])
def test_distances_and_gradients_are_those_of_the_reference(runner, count):
    points, segments = points_and_segments(count)
    wide = points.double().requires_grad_()
    wanted = distance_to_segments(wide, segments.double())
    distance, direction = runner(points, segments)
    torch.testing.assert_close(distance.double(), wanted.detach(), rtol=0, atol=1e-6)
    torch.testing.assert_close(direction.double(), torch.autograd.grad(wanted.sum(), wide)[0], rtol=0, atol=2e-5)


def test_a_point_on_a_segment_has_no_direction(runner):
    _, segments = points_and_segments(0)
    distance, direction = runner(segments[:, 0], segments)
    torch.testing.assert_close(distance, torch.full((9,), 1e-6))
    assert not direction.any()


def test_distances_of_strided_points(runner):
    points, segments = points_and_segments(20)
    strided = torch.stack([points, points], 2)[..., 0]
    backwards = segments.transpose(0, 1).contiguous().transpose(0, 1)
    assert not strided.is_contiguous()
    assert not backwards.is_contiguous()
    for found, wanted in zip(runner(strided, backwards), runner(points, segments), strict=True):
        assert torch.equal(found, wanted)


@pytest.mark.parametrize("block", [2, 7, 64])
def test_the_number_of_threads_does_not_matter(block):
    require_compiler()
    arrays = points_and_segments(130)
    assert all(map(torch.equal, Runner("emulated")(*arrays), Runner("emulated", block)(*arrays)))
