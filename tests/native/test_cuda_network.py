"""The network's CUDA kernels, on a GPU where there is one, and by an emulation that has a warp's tensor cores."""

from __future__ import annotations

import ctypes
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler
from torch.nn import functional as F

from snarfcli.native import cuda_driver, cuda_network
from snarfcli.native.cuda_compile import cuda_sources
from snarfcli.native.cuda_network import NetworkArrays, fits, run_network
from snarfcli.networks.occupancy import occupancy_reference
from snarfcli.segments import distance_to_segments
from snarfcli.shape import OccupancyNetwork, ShapeConfig
from snarfcli.shape.inference import occupancy_arguments
from snarfcli.shape.network import LOGITS_PER_METRE, SOFTPLUS_SHARPNESS, _local_code

CONF = Path(__file__).parents[2] / "conf"
PARTS = 5
ROUNDED = ("high", "bfloat16")
TWO_LAYERS = ShapeConfig(depth=2, skip_layers=[1], condition_layer=1, frequencies=[2.0, 5.0])
ODD = ShapeConfig(width=37, depth=4, skip_layers=[1, 3, 4], condition_layer=3, frequencies=[3.0], prior_radius_m=0.1)


def preset(shape: str, condition: str = "global") -> ShapeConfig:
    """Return the network that a file of conf/shape and one of conf/condition describe."""
    config, chosen = (
        {name: value for name, value in yaml.safe_load(path.read_text()).items() if name != "defaults"}
        for path in (CONF / "shape" / f"{shape}.yaml", CONF / "condition" / f"{condition}.yaml")
    )
    made = ShapeConfig(**config)
    made.condition_layer = made.condition_layer if chosen["layer"] is None else chosen["layer"]
    made.condition_size = made.condition_size if chosen["size"] is None else chosen["size"]
    return replace(made, condition_layer=None) if condition == "none" else made


SHAPES = sorted(path.stem for path in (CONF / "shape").glob("*.yaml"))
PRESETS = {f"{shape}-{kind}": (preset(shape, kind), kind) for shape in SHAPES for kind in ("global", "local", "none")}
CASES = PRESETS | {
    "odd-global": (ODD, "global"),
    "odd-local": (ODD, "local"),
    "code at the input": (replace(preset("small"), condition_layer=0), "global"),
    "three features": (replace(preset("grid"), features=3), "local"),
    "one output": (ShapeConfig(width=1, depth=1, skip_layers=[], condition_layer=None), "none"),
}


def network_of(config: ShapeConfig, dtype: torch.dtype = torch.float32) -> OccupancyNetwork:
    torch.manual_seed(3)
    bones = torch.rand(7, 2, 3) - 0.5
    bones[2, 1] = bones[2, 0]  # a bone without length
    network = OccupancyNetwork(config, 3 * PARTS, bones, (torch.full((3,), -1.0), torch.full((3,), 1.1)))
    if network.grids is not None:
        network.grids.cover(torch.rand(6, 6, 6) > 0.5)
        network.grids.table.data.normal_()
    for parameter in network.parameters():  # also those that start from zero
        parameter.data += 0.05 * torch.randn_like(parameter)
    return network.to(dtype)


def inputs_of(count: int, kind: str = "global", poses: int = 3) -> tuple:
    """Return points [N, 3], the condition [B, C], the pose of each point and what it sees of it."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(count, 3, generator=generator) * 2.4 - 1.2
    condition = torch.randn(poses, 3 * PARTS, generator=generator)
    pose = torch.randint(0, poses, (count,), generator=generator)
    return points, condition, pose, torch.rand(count, PARTS, generator=generator) if kind == "local" else None


class Runner:
    """Evaluates networks on the emulation or on a GPU; takes and returns CPU tensors."""

    def __init__(self, device: str) -> None:
        self.place = "cpu" if device == "emulated" else "cuda"
        empty = torch.empty(0, device=self.place)
        self.gpu = EmulatedGpu(torch.float32) if device == "emulated" else cuda_driver.gpu(empty)

    @torch.no_grad()
    def __call__(self, network: OccupancyNetwork, inputs: tuple, precision: str = "highest", **changed) -> torch.Tensor:
        inputs = tuple(None if value is None else value.to(self.place) for value in inputs)
        arrays = replace(NetworkArrays(*occupancy_arguments(network.to(self.place), *inputs)), **changed)
        assert fits(self.gpu, arrays, precision)
        return run_network(self.gpu, arrays, precision).cpu()


@pytest.fixture(params=["emulated", "cuda"] if torch.cuda.is_available() else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


def rounded(values: torch.Tensor, precision: str) -> torch.Tensor:
    """Return float64 numbers rounded as an operand of a product in the precision."""
    if precision == "bfloat16":
        return values.bfloat16().double()
    step = torch.exp2(values.abs().clamp_min(1e-30).log2().floor() - 10)  # TF32 has 10 bits behind the leading one
    return (values / step).round() * step if precision == "high" else values


def doubled(inputs: tuple) -> tuple:
    return tuple(given.double() if given is not None and given.is_floating_point() else given for given in inputs)


@torch.no_grad()
def wanted_of(config: ShapeConfig, inputs: tuple, precision: str = "highest") -> torch.Tensor:
    """Return the logits in float64; the operands of all products but those of the last layer are rounded."""
    points, condition, pose, seen = doubled(inputs)
    network = network_of(config, torch.float64)
    first, code = network._encode(points), None
    if network.pose_code is not None:
        code = network.pose_code(condition)[pose] if seen is None else _local_code(network.pose_code, condition, pose, seen)
    h = None
    for index, layer in enumerate(network.linears):
        parts = [h, first if index == 0 or index in config.skip_layers else None]
        parts.append(code if index == config.condition_layer else None)
        values, weight = torch.cat([part for part in parts if part is not None], 1), network._weight(index, layer)
        if index < config.depth:
            h = rounded(values, precision) @ rounded(weight, precision).T + layer.bias
            h = F.relu(h) if config.activation == "relu" else F.softplus(h, beta=SOFTPLUS_SHARPNESS)
        else:
            h = values @ weight.T + layer.bias
    assert h is not None
    logits = h[:, 0]
    if config.prior_radius_m is not None:
        logits = logits + LOGITS_PER_METRE * (config.prior_radius_m - distance_to_segments(points, network.bones))
    return logits


# ---------------------------------------------------------------- structures
def test_structures_and_constants_match_the_kernels():
    require_compiler()
    library = build_emulation(torch.float32, "network")
    assert library.packing_bytes() == ctypes.sizeof(cuda_network._Packing)
    assert library.evaluation_bytes() == ctypes.sizeof(cuda_network._Evaluation)
    sources = "".join((cuda_sources() / "cuda" / name).read_text() for name in ("network.cu", "products.cuh"))
    for name in ("MOST_LAYERS", "MOST_LEVELS", "PACKING_THREADS", "COLUMNS", "PADDING"):
        constant = "k" + name.title().replace("_", "")
        assert f"{constant} = {getattr(cuda_network, f'_{name}')};" in sources
    for points, widest in cuda_network._WIDEST.items():
        assert len(re.findall(rf"__launch_bounds__\({widest}\) evaluate_\w+_{points}\(", sources)) == 3


# ---------------------------------------------------------------- values
@pytest.mark.parametrize("name", CASES)
def test_float32_agrees_with_the_network(runner, name):
    config, kind = CASES[name]
    inputs = inputs_of(67, kind)
    wanted = wanted_of(config, inputs)
    with torch.no_grad():
        theirs = network_of(config)(*inputs)
        exact = network_of(config, torch.float64)(*doubled(inputs))
    torch.testing.assert_close(wanted, exact)
    scale = float(wanted.abs().max())
    mine, theirs = (float((logits - wanted).abs().max()) / scale for logits in (runner(network_of(config), inputs), theirs))
    assert mine < max(2 * theirs, 2e-6)  # fp32, up to 260 terms in each of 9 layers; measured worst 9e-7


@pytest.mark.parametrize("precision", ROUNDED)
@pytest.mark.parametrize("name", CASES)
def test_lower_precision_is_near_the_network(runner, name, precision):
    """In 9 layers one number rounded the other way changes others, so the bound is one on the error of rounding itself."""
    config, kind = CASES[name]
    inputs = inputs_of(67, kind)
    wanted = wanted_of(config, inputs)
    off = float((runner(network_of(config), inputs, precision) - wanted).abs().max()) / float(wanted.abs().max())
    assert 0 < off < {"high": 2e-3, "bfloat16": 1e-2}[precision]  # measured worst 6e-4 and 4e-3


@pytest.mark.parametrize("precision", ROUNDED)
@pytest.mark.parametrize("width", [33, 64, 160])
def test_lower_precision_rounds_the_operands_and_nothing_else(runner, width, precision):
    config = replace(TWO_LAYERS, width=width)
    inputs = inputs_of(131, "local")
    wanted, exact = wanted_of(config, inputs, precision), wanted_of(config, inputs)
    off = (runner(network_of(config), inputs, precision) - wanted).norm()
    assert off < (exact - wanted).norm() / 5  # a few numbers are beside a half and are rounded the other way


@pytest.mark.parametrize("precision", ["highest", *ROUNDED])
@pytest.mark.parametrize(("width", "tile"), [(40, 64), (160, 128)])
def test_a_point_does_not_depend_on_the_others(runner, width, tile, precision):
    network = network_of(replace(TWO_LAYERS, width=width))
    points, condition, pose, seen = inputs_of(2 * tile, "local")
    every = runner(network, (points, condition, pose, seen), precision)
    for count in (0, 1, tile - 1, tile, tile + 1):
        part = runner(network, (points[:count], condition, pose[:count], seen[:count]), precision)
        assert torch.equal(part, every[:count])


def test_arguments_may_be_strided_and_rows_of_padding_have_any_pose(runner):
    network = network_of(TWO_LAYERS)
    points, condition, pose, seen = inputs_of(20, "local")
    wanted = runner(network, (points, condition, pose, seen))
    strided = [given.T.contiguous().T for given in (points, condition, seen)]
    doubled = pose.repeat_interleave(2)[::2]
    assert torch.equal(runner(network, (strided[0], strided[1], doubled, strided[2])), wanted)
    pose[3:] = len(condition)
    assert torch.equal(runner(network, (points, condition, pose, seen))[:3], wanted[:3])


@pytest.mark.parametrize("precision", ["highest", *ROUNDED])
def test_far_and_broken_points(runner, precision):
    network = network_of(preset("small"))
    points = torch.tensor([[30.0, -40, 50], [float("nan"), 0, 0], [0.2, float("inf"), 0]])
    inputs = (points, torch.zeros(1, 3 * PARTS), torch.zeros(3, dtype=torch.long), None)
    found, wanted = runner(network, inputs, precision), wanted_of(preset("small"), inputs, precision)
    torch.testing.assert_close(found[:1].double(), wanted[:1], rtol=1e-4, atol=0)
    assert not found[1:].isfinite().any()
    assert not wanted[1:].isfinite().any()


def test_changed_weights_are_used_at_once(runner):
    network, inputs = network_of(TWO_LAYERS), inputs_of(5)
    before = runner(network, inputs)
    with torch.no_grad():
        network.linears[1].bias.data += 0.1  # no counter of PyTorch sees this
        assert not torch.equal(runner(network, inputs), before)


# ---------------------------------------------------------------- limits
def arrays_of(config: ShapeConfig, count: int = 200_000) -> NetworkArrays:
    with torch.no_grad():
        return NetworkArrays(*occupancy_arguments(network_of(config), *inputs_of(count)))


class Chip(EmulatedGpu):
    """A launcher that only tells what it is."""

    multiprocessors = 132

    def __init__(self, capability: tuple[int, int], kilobytes: int) -> None:
        self.capability, self.most_shared_bytes = capability, 1024 * kilobytes


HOPPER, AMPERE, CONSUMER, TURING = Chip((9, 0), 227), Chip((8, 0), 163), Chip((8, 9), 99), Chip((7, 5), 64)


def test_points_of_a_block_follow_the_network_and_the_chip():
    def points(chip: Chip, config: ShapeConfig, precision: str) -> int | None:
        arrays = arrays_of(config)
        found = cuda_network._points_at_once(chip, arrays, cuda_network._kernels(chip, precision))
        assert fits(chip, arrays, precision) == (found is not None)
        return found

    paper = preset("mlp")
    assert [points(HOPPER, paper, precision) for precision in ("highest", "high", "bfloat16")] == [128] * 3
    assert [points(CONSUMER, paper, precision) for precision in ("highest", "high", "bfloat16")] == [64, 64, 128]
    assert points(AMPERE, paper, "medium") == 128
    assert points(TURING, paper, "bfloat16") is None  # float32, too large for it
    assert points(TURING, preset("grid"), "bfloat16") == points(HOPPER, preset("grid"), "bfloat16") == 64
    assert points(HOPPER, replace(paper, width=384), "high") == 64
    assert points(HOPPER, replace(paper, width=385), "high") is None


def test_few_points_are_spread_over_all_multiprocessors():
    def points(count: int) -> int | None:
        return cuda_network._points_at_once(HOPPER, arrays_of(preset("mlp"), count), "tf32")

    assert [points(count) for count in (0, 100, 132 * 64, 132 * 128)] == [128, 64, 64, 128]
    assert points(20_000) == 64  # three times 64 in turn, not twice 128


def test_networks_that_do_not_fit():
    grid = replace(preset("grid"), feature_cells_m=[0.5] * 9)
    for config in (replace(preset("mlp"), depth=17), replace(ODD, depth=0, condition_layer=None), grid):
        assert not fits(HOPPER, arrays_of(config), "highest")
    arrays = arrays_of(TWO_LAYERS)
    assert fits(HOPPER, arrays, "highest")
    assert not fits(HOPPER, replace(arrays, code_layer=arrays.layers), "highest")  # the last layer, which is summed apart
    assert not fits(HOPPER, replace(arrays, codes=arrays.codes[:, :, :0]), "highest")


def test_chips_without_tensor_cores_use_float32():
    assert cuda_network._kernels(TURING, "bfloat16") == cuda_network._kernels(HOPPER, "highest") == "float32"
    assert cuda_network._kernels(AMPERE, "bfloat16") == "bfloat16"


# ---------------------------------------------------------------- the operator
@pytest.mark.parametrize("name", ["grid-local", "mlp-global", "odd-local"])
def test_reference_agrees_with_the_network(name):
    config, kind = CASES[name]
    inputs = inputs_of(50, kind)
    network = network_of(config)
    with torch.no_grad():
        arrays = NetworkArrays(*occupancy_arguments(network, *inputs))
        torch.testing.assert_close(occupancy_reference(arrays, "highest"), network(*inputs), rtol=1e-5, atol=1e-5)
