"""The native evaluation of the occupancy network against the network itself."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from snarfcli.native.library import build_note, instruction_set, native_library
from snarfcli.shape import OccupancyNetwork, ShapeConfig, inference
from snarfcli.shape.inference import can_evaluate, evaluate

PARTS = 5
PAPER = ShapeConfig(width=256, depth=8)
SMALL = ShapeConfig(
    width=128, depth=6, activation="relu", skip_layers=[], frequencies=[2.0, 4.0, 8.0, 16.0], condition_layer=2,
    condition_size=16, geometric_init=False, weight_norm=False, prior_radius_m=0.07,
)  # fmt: skip
ODD = replace(PAPER, width=37, depth=4, skip_layers=[1, 3], condition_layer=3, frequencies=[3.0], prior_radius_m=0.1)
CONFIGS = {
    "paper": PAPER,
    "small": SMALL,
    "odd": ODD,
    "first": replace(SMALL, condition_layer=0, width=64),
    "grids": replace(SMALL, width=64, depth=3, feature_cells_m=[0.5, 0.11], features=3),
    "none": replace(PAPER, condition_layer=None, depth=3),
    "narrow": replace(PAPER, width=1, depth=1, skip_layers=[], condition_layer=None),
}


def network_of(config: ShapeConfig, dtype=torch.float32) -> OccupancyNetwork:
    torch.manual_seed(3)
    bones = torch.rand(7, 2, 3) - 0.5
    bones[2, 1] = bones[2, 0]  # a bone without length
    network = OccupancyNetwork(config, 3 * PARTS, bones, (torch.full((3,), -1.0), torch.full((3,), 1.1)))
    if network.grids is not None:
        network.grids.cover(torch.rand(6, 6, 6) > 0.5)
    for parameter in network.parameters():  # also those that start from zero
        parameter.data += 0.05 * torch.randn_like(parameter)
    return network.to(dtype)


@pytest.fixture(autouse=True)
def there_is_a_library():
    assert native_library() is not None


CASES = [(name, local) for name in CONFIGS for local in (False, True) if not (local and CONFIGS[name].condition_layer is None)]


@pytest.mark.parametrize(("name", "local"), CASES)
def test_agrees_with_the_network(name, local):
    network = network_of(CONFIGS[name])
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(1001, 3, generator=generator) * 2.4 - 1.2
    condition = torch.randn(3, 3 * PARTS, generator=generator)
    pose = torch.randint(0, 3, (len(points),), generator=generator)
    seen = torch.rand(len(points), PARTS, generator=generator) if local else None
    with torch.no_grad():
        assert can_evaluate(network, points)
        exact = network_of(CONFIGS[name], torch.float64)
        wanted = exact(points.double(), condition.double(), pose, None if seen is None else seen.double())
        scale = float(wanted.abs().max())
        mine = (evaluate(network, points, condition, pose, seen) - wanted).abs().max() / scale
        torchs = (network(points, condition, pose, seen) - wanted).abs().max() / scale
    # fp32, up to 260 terms in each of 9 layers; PyTorch's own worst is 2e-6 of the largest logit
    assert mine < max(2 * float(torchs), 2e-6)


@pytest.mark.parametrize(("name", "local"), CASES)
def test_a_gpu_is_asked_for_the_same_network(name, local):
    """Here the operator of a GPU runs as on a CPU, which is its readable version."""
    network = network_of(CONFIGS[name])
    generator = torch.Generator().manual_seed(1)
    points, condition = torch.rand(50, 3, generator=generator), torch.randn(3, 3 * PARTS, generator=generator)
    pose = torch.arange(50) % 3
    seen = torch.rand(len(points), PARTS, generator=generator) if local else None
    with torch.no_grad():
        wanted = network(points, condition, pose, seen)
        got = inference._evaluate_on_gpu(network, points, condition, pose, seen, "highest")
    torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 1000])
def test_a_point_does_not_depend_on_the_others(count):
    network = network_of(SMALL)
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(2))
    condition, pose = torch.ones(1, 3 * PARTS), torch.zeros(1000, dtype=torch.long)
    with torch.no_grad():
        every = evaluate(network, points, condition, pose)
        part = evaluate(network, points[:count], condition, pose[:count])
        strided = evaluate(network, points.T.contiguous().T[:count], condition, pose[:count])
    assert torch.equal(part, every[:count])
    assert torch.equal(strided, every[:count])


def test_far_steep_and_broken_points():
    """Points where the softplus is linear or flat, far points, and NaN, which must stay NaN."""
    network = network_of(PAPER)
    points = torch.tensor([[30.0, -40, 50], [1e-6, 0, 0], [float("nan"), 0, 0], [0.2, float("inf"), 0]])
    condition, pose = torch.zeros(1, 3 * PARTS), torch.zeros(4, dtype=torch.long)
    with torch.no_grad():
        wanted, got = network(points, condition, pose), evaluate(network, points, condition, pose)
    torch.testing.assert_close(got[:2], wanted[:2], rtol=1e-5, atol=1e-5)
    assert not got[2:].isfinite().any()
    assert not wanted[2:].isfinite().any()


def test_waves_of_large_angles():
    """The encoding only: sines and cosines of positive and negative angles in each quadrant."""
    config = replace(SMALL, width=1, depth=1, frequencies=[1.0], condition_layer=None, prior_radius_m=None, weight_norm=False)
    angles = torch.linspace(-60, 60, 4001)
    points = torch.stack([angles, 0.1 + 0 * angles, 0 * angles], 1)
    for column in (3, 6):  # the sine and the cosine of x
        network = network_of(config)
        for parameter in network.parameters():
            parameter.data.zero_()
        network.layers[0].weight.data[0, column] = 1.0
        network.layers[0].bias.data[0] = 2.0
        network.layers[1].weight.data[0, 0] = 1.0
        with torch.no_grad():
            got = evaluate(network, points, torch.zeros(1, 3 * PARTS), torch.zeros(len(points), dtype=torch.long)) - 2
        wanted = angles.double().sin() if column == 3 else angles.double().cos()
        torch.testing.assert_close(got.double(), wanted, rtol=0, atol=4e-7)  # 2 is added and taken away in float32


def test_conditions_for_the_native_evaluation():
    network, points = network_of(SMALL), torch.zeros(1, 3)
    assert not can_evaluate(network, points)  # gradients are wanted
    with torch.no_grad():
        assert not can_evaluate(network, points.double())
        assert not can_evaluate(network.double(), points)
        assert not can_evaluate(torch.nn.Linear(3, 1), points)


@pytest.mark.parametrize(("backend", "expected"), [("native", True), ("reference", False)])
def test_a_gpu_evaluates_natively_where_it_has_kernels(backend, expected, monkeypatch):
    asked = []
    monkeypatch.setattr(inference, "choose_backend", lambda *question: asked.append(question) or backend)
    gpu = torch.device("cuda", 1)
    assert inference._has_kernels(gpu) == expected
    assert asked == [("auto", gpu)]
    assert not inference._has_kernels(torch.device("meta"))


@pytest.mark.parametrize("name", ["avx2", "baseline"])
def test_other_instruction_sets(name):
    """The library chooses once per process, so these run in other processes."""
    there = build_note().get("instruction_sets", [])
    if name not in there:
        pytest.skip(f"this library is built for {', '.join(there) or 'nothing that it tells'} only")
    if name == "avx2" and instruction_set() == "baseline":
        pytest.skip("this processor has no AVX2")
    code = (
        "import torch, test_inference as t; from snarfcli.native.library import instruction_set;"
        f"assert instruction_set() == '{name}';"
        "[t.test_agrees_with_the_network(*case) for case in t.CASES];"
        "t.test_far_steep_and_broken_points(); t.test_waves_of_large_angles();"
        "t.test_a_point_does_not_depend_on_the_others(129)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"SNARF_INSTRUCTION_SET": name, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
