"""The CUDA kernels of the encoding of points, run through the same launches on a GPU, if there is one, or by an emulation."""

from __future__ import annotations

import ctypes

import pytest
import torch
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler
from encoding_arrays import encoding_arrays
from torch import Tensor

from snarfcli.native import cuda_compile, cuda_encoding
from snarfcli.native.cuda_encoding import run_encode, run_encode_backward
from snarfcli.networks.encoding import encode, encode_backward, encode_reference

HAS_GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not HAS_GPU, reason="needs a CUDA device")

BLOCK = cuda_encoding._THREADS


class Runner:
    """Runs the kernels, on the emulation or on a GPU, with arrays on the CPU."""

    def __init__(self, device: str, block: int = 1) -> None:
        self.device = device
        self.gpu = EmulatedGpu(torch.float32, block) if device == "emulated" else None

    def encode(self, points: Tensor, frequencies: Tensor, table: Tensor, rows: Tensor, *grids) -> Tensor:
        if self.gpu:
            return run_encode(self.gpu, points, frequencies, table, rows, *grids)
        return encode(points.cuda(), frequencies.cuda(), table.cuda(), rows.cuda(), *grids).cpu()

    def backward(self, gradient: Tensor, encoded: Tensor, points, frequencies, table, rows, *rest) -> tuple[Tensor, Tensor]:
        given = (gradient, encoded, points, frequencies, table, rows)
        if self.gpu:
            return run_encode_backward(self.gpu, *given, *rest)
        v_points, v_table = encode_backward(*(tensor.cuda() for tensor in given), *rest)
        return v_points.cpu(), v_table.cpu()


@pytest.fixture(params=["emulated", "cuda"] if HAS_GPU else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


def wanted(gradient: Tensor, points: Tensor, frequencies: Tensor, table: Tensor, *grids) -> list[Tensor]:
    """Return the encoding and its two gradients by the readable version, in float64."""
    wide = [points.double().requires_grad_(), table.double().requires_grad_()]
    out = encode_reference(wide[0], frequencies.double(), wide[1], *grids)
    return [out.detach(), *torch.autograd.grad(out, wide, gradient.double(), materialize_grads=True)]


def check(runner: Runner, arrays, gradient: Tensor | None = None) -> list[Tensor]:
    """Compare the kernels with the readable version, forward and backward; return what they gave."""
    encoded = runner.encode(*arrays)
    gradient = torch.randn(encoded.shape, generator=torch.Generator().manual_seed(1)) if gradient is None else gradient
    found = [encoded, *runner.backward(gradient, encoded, *arrays, True, True)]
    right = wanted(gradient, *arrays)
    torch.testing.assert_close(encoded.double(), right[0], rtol=1e-5, atol=5e-5)  # places in cells to 1e-6, features up to 4
    for one, other in zip(found[1:], right[1:], strict=True):
        assert one.shape == other.shape
        assert (one - other).norm() <= 5e-5 * other.norm() + 1e-9
    return found


# ---------------------------------------------------------------- arguments
def test_structures_and_constants_match_the_kernels():
    require_compiler()
    assert build_emulation(torch.float32).encoding_bytes() == ctypes.sizeof(cuda_encoding._Encoding) < 4096
    source = (cuda_compile.cuda_sources() / "cuda" / "encoding.cu").read_text()
    assert f"kEncodingLevels = {cuda_encoding.MAX_LEVELS};" in source
    assert source.count(f"__launch_bounds__({BLOCK})") == 2


def test_levels_that_the_kernels_cannot_take_are_refused():
    points, frequencies, table, rows, nodes, boxes = encoding_arrays(1)
    for wrong in (nodes[:3] * 33, [*nodes[:5], 1]):
        with pytest.raises(ValueError, match="nodes: wanted at most 32 levels of 2 nodes or more along a side, got"):
            cuda_encoding._Points(points, frequencies, table, rows, wrong, boxes * 33)


# ---------------------------------------------------------------- results
@pytest.mark.parametrize("features", [1, 2, 3, 4, 6, 16])
@pytest.mark.parametrize("count", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1])
def test_values_and_gradients_are_those_of_the_reference(runner, count, features):
    check(runner, encoding_arrays(count, features))


@pytest.mark.parametrize("cells", [(0.4,), (0.5, 0.3, 0.2, 0.15, 0.1)])
@pytest.mark.parametrize("frequencies", [(), (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)])
def test_any_number_of_levels_and_frequencies(runner, cells, frequencies):
    check(runner, encoding_arrays(300, 4, cells, frequencies))


def test_without_grids_only_waves(runner):
    points, frequencies, *_ = encoding_arrays(300)
    arrays = (points, frequencies, torch.empty(0, 1), torch.empty(0, dtype=torch.int32), [], [])
    encoded, _, v_table = check(runner, arrays)
    assert encoded.shape == (300, 15)
    assert v_table.numel() == 0
    check(runner, (points, frequencies[:0], *arrays[2:]))


def test_nodes_without_features_count_as_zeros(runner):
    points, frequencies, table, rows, nodes, boxes = encoding_arrays(700)
    assert 0.2 < (rows < 0).float().mean() < 0.8
    without = torch.where(rows % 5 == 0, -1, rows)
    encoded, _, v_table = check(runner, (points, frequencies, table, without, nodes, boxes))
    assert not v_table[::5].any()
    beyond = torch.where(without < 0, len(table) + 7, without)  # nor is there a row beyond the table
    assert torch.equal(runner.encode(points, frequencies, table, beyond, nodes, boxes), encoded)
    encoded = runner.encode(points, frequencies, table, torch.full_like(rows, -1), nodes, boxes)
    assert not encoded[:, 15:].any()


def test_points_on_the_border_have_features_and_those_outside_none(runner):
    _, frequencies, table, rows, nodes, boxes = encoding_arrays(1, cells=(0.25,))  # a power of two: places without rounding
    lower, size = torch.tensor(boxes[:3]), torch.tensor(boxes[3:])
    rows = torch.arange(len(rows), dtype=torch.int32) % len(table)
    last = torch.tensor(nodes) - 1
    border = torch.stack([lower, lower + torch.tensor([0.0, 1.0, 1.0]) * size])
    outside = torch.stack([lower - 0.1, lower + size * last + 0.1, torch.tensor([torch.nan, 0.0, 0.0]), torch.full((3,), 9e9)])
    arrays = (frequencies[:0], table, rows, nodes, boxes)
    assert (runner.encode(border, *arrays)[:, 3:] != 0).all()
    encoded = runner.encode(outside, *arrays)
    assert not encoded[:, 3:].any()
    v_points, v_table = runner.backward(torch.ones_like(encoded), encoded, outside, *arrays, True, True)
    assert torch.equal(v_points, torch.ones(4, 3))
    assert not v_table.any()


def test_values_are_those_of_the_cpu(runner):
    """One formula for both (csrc/include/snarf), but multiplications and additions may be contracted."""
    arrays = encoding_arrays(1000)
    encoded = runner.encode(*arrays)
    torch.testing.assert_close(encoded, encode(*arrays), rtol=2e-6, atol=2e-5)
    given = (torch.ones_like(encoded), encoded, *arrays, True, True)
    for found, right in zip(runner.backward(*given), encode_backward(*given), strict=True):
        torch.testing.assert_close(found, right, rtol=1e-5, atol=1e-4)  # slopes of up to 100 a metre


@pytest.mark.parametrize("wants", [(True, False), (False, True), (False, False)])
def test_gradients_that_are_not_wanted_are_empty(runner, wants):
    arrays = encoding_arrays(100)
    encoded = runner.encode(*arrays)
    found = runner.backward(encoded, encoded, *arrays, *wants)
    both = runner.backward(encoded, encoded, *arrays, True, True)
    for one, other, is_wanted in zip(found, both, wants, strict=True):
        torch.testing.assert_close(one, other if is_wanted else torch.empty(0), rtol=1e-5, atol=1e-5)  # atomics on a GPU


def test_points_without_a_gradient_add_nothing(runner):
    arrays = encoding_arrays(200)
    gradient = torch.randn(200, 23, generator=torch.Generator().manual_seed(2))
    gradient[50:] = 0
    check(runner, arrays, gradient)
    gradient[:, 19:] = 0  # of the last level
    _, _, v_table = check(runner, arrays, gradient)
    of_level = arrays[3][-torch.tensor(arrays[4][3:]).prod() :]
    assert not v_table[of_level[of_level >= 0].long()].any()


def test_arrays_may_be_strided_or_start_anywhere(runner):
    points, frequencies, table, *grids = encoding_arrays(50)
    strided = torch.stack([points, points], 2)[..., 0]
    shifted = torch.cat([table.new_zeros(1), table.flatten()])[1:].view_as(table)
    gradient = torch.randn(23, 50, generator=torch.Generator().manual_seed(3)).t()
    assert not strided.is_contiguous()
    assert shifted.data_ptr() % 16
    assert not gradient.is_contiguous()
    check(runner, (strided, frequencies, shifted, *grids), gradient)


@pytest.mark.parametrize("block", [2, 7, 64])
def test_the_number_of_threads_does_not_matter(block):
    require_compiler()
    arrays = encoding_arrays(130)
    alone, together = check(Runner("emulated"), arrays), check(Runner("emulated", block), arrays)
    assert torch.equal(alone[0], together[0])
    assert torch.equal(alone[1], together[1])


# ---------------------------------------------------------------- launches
def test_one_launch_each_way_and_none_without_points():
    require_compiler()
    for count, wants, launches in ((9, True, 2), (9, False, 1), (0, True, 0)):
        emulated, arrays = EmulatedGpu(torch.float32), encoding_arrays(count)
        encoded = run_encode(emulated, *arrays)
        run_encode_backward(emulated, encoded, encoded, *arrays, wants, wants)
        assert emulated.launches == ["encode_points", "encode_backward"][:launches]


# ---------------------------------------------------------------- on a GPU
@needs_gpu
def test_gradients_fit_into_a_cuda_graph():
    points, frequencies, table, rows, *grids = encoding_arrays(5000)
    given = [tensor.cuda().requires_grad_() for tensor in (points, table)]
    frequencies, rows = frequencies.cuda(), rows.cuda()

    def evaluate() -> list[Tensor]:
        out = encode(given[0], frequencies, given[1], rows, *grids)
        return [out, *torch.autograd.grad(out.square().sum(), given)]

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        evaluate()  # loads the kernels
    stream.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        replayed = evaluate()
    with torch.no_grad():
        given[0].add_(0.01)
    graph.replay()
    for found, right in zip(replayed, evaluate(), strict=True):
        torch.testing.assert_close(found, right, rtol=1e-5, atol=1e-4)
