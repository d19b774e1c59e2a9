"""The CUDA kernel of values between grid nodes, run through the same launch on a GPU, if there is one, or by an emulation."""

from __future__ import annotations

import ctypes

import pytest
import torch
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.trilinear import interpolate, interpolate_nodes
from snarfcli.native import cuda_interpolation
from snarfcli.native.cuda_interpolation import run_interpolate

HAS_GPU = torch.cuda.is_available()
BLOCK = cuda_interpolation._THREADS
BOX = torch.tensor([-0.4, -1.0, -0.3]), torch.tensor([0.5, 0.9, 0.2])


class Runner:
    """Runs the kernel, on the emulation or on a GPU, with arrays on the CPU."""

    def __init__(self, device: str, block: int = 1) -> None:
        self.device, self.block = device, block

    def __call__(self, values: Tensor, points: Tensor) -> Tensor:
        box = [corner.to(values) for corner in BOX]
        if self.device == "emulated":
            return run_interpolate(EmulatedGpu(values.dtype, self.block), values, points, *box)
        return interpolate_nodes(values.cuda(), points.cuda(), *(corner.cuda() for corner in box)).cpu()


@pytest.fixture(params=["emulated", "cuda"] if HAS_GPU else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


def arrays(count: int, channels: int = 3, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Return values and points, inside and outside of the box and on its corners."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator) * 0.6
    points[: count // 9] = BOX[1]
    points[: count // 18] = BOX[0]
    return torch.rand(4, 9, 6, channels, generator=generator).to(dtype), points.to(dtype)


def wanted(values: Tensor, points: Tensor) -> Tensor:
    return interpolate(values.double(), points.double(), CanonicalGrid(*(corner.double() for corner in BOX)))


def test_structure_matches_the_kernel():
    require_compiler()
    assert build_emulation(torch.float32).interpolation_bytes() == ctypes.sizeof(cuda_interpolation._Interpolation)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize(("count", "channels"), [(0, 3), (1, 1), (BLOCK - 1, 1), (BLOCK, 1), (BLOCK + 1, 1), (100, 24)])
def test_values_are_those_of_the_reference(runner, count, channels, dtype):
    values, points = arrays(count, channels, dtype)
    found = runner(values, points)
    assert found.dtype == dtype
    tolerance = 2e-6 if dtype == torch.float32 else 1e-12  # places in cells to 1e-6
    torch.testing.assert_close(found.double(), wanted(values, points), rtol=0, atol=tolerance)


def test_points_that_are_not_finite(runner):
    values, points = arrays(4)
    points[:] = torch.tensor([[torch.nan, 0, 0], [0, torch.inf, 0], [0, 0, -torch.inf], [0, -torch.inf, torch.nan]])
    found = runner(values, points)
    assert found[[0, 3]].isnan().all()
    border = points.clamp(*BOX)
    torch.testing.assert_close(found[1:3].double(), wanted(values, border)[1:3], rtol=0, atol=2e-6)


def test_strided_values_and_any_number_of_threads(runner):
    values, points = arrays(90)
    strided = values.transpose(0, 2).contiguous().transpose(0, 2)
    assert not strided.is_contiguous()
    assert torch.equal(runner(strided, points), runner(values, points))
    if runner.device == "emulated":
        for block in (2, 7):
            assert torch.equal(Runner("emulated", block)(values, points), runner(values, points))


def test_a_side_without_a_cell_is_refused(runner):
    with pytest.raises(ValueError, match=r"values: wanted at least 2 nodes along each side, got \[4, 1, 6\]"):
        runner(torch.zeros(4, 1, 6, 3), torch.zeros(2, 3))


def test_operator_contract():
    values, points = arrays(7)
    torch.library.opcheck(interpolate_nodes, (values, points, *BOX))
