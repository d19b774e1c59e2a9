"""Time of the networks of a training step, forward and backward: natively, and layer by layer in PyTorch.

    python benchmarks/bm_networks.py

Untrained networks of the sizes of the presets, on as many points as a step of the preset evaluates, timed in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median

import torch
from common import arguments, in_pytorch, median_and_spread, print_machine, print_table, timed

from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.hierarchy import PlainSoftmax
from snarfcli.deformer.weights import NetworkWeights
from snarfcli.shape import OccupancyNetwork, ShapeConfig

_JOINTS = 23
_BOX = (torch.full((3,), -1.0), torch.full((3,), 1.0))
_SMALL = ShapeConfig(
    width=128, depth=6, activation="relu", skip_layers=[], frequencies=[2.0, 4.0, 8.0, 16.0], condition_layer=2,
    condition_size=16, geometric_init=False, weight_norm=False, prior_radius_m=0.07,
)  # fmt: skip
_GRID = ShapeConfig(
    name="grid", width=64, depth=3, activation="relu", skip_layers=[], frequencies=[2.0, 4.0, 8.0, 16.0], condition_layer=2,
    condition_size=16, geometric_init=False, weight_norm=False, prior_radius_m=0.07, feature_cells_m=[0.12, 0.06, 0.03, 0.02],
)  # fmt: skip
_SHAPES = {
    "shape=small, 7,300 points": (_SMALL, 7300),
    "shape=grid, 7,300 points": (_GRID, 7300),
    "shape=mlp (papers), 18,000 points": (ShapeConfig(), 18_000),
}


def main() -> None:
    options = arguments("Networks of a training step.")
    print_machine()
    rows = []
    for name, (config, count) in _SHAPES.items():
        rows.append([name, *_compared(_shape_step(config, count), options.repeats)])
    rows.append(["skinning=coarse, 2,500 nodes", *_compared(_weights_step(2500, 3), options.repeats)])
    rows.append(["skinning=distilled, 20,000 nodes", *_compared(_weights_step(20_000, 4), options.repeats)])
    print_table(["network, forward and backward", "native, ms", "PyTorch, ms", "ratio"], rows)


def _compared(step: Callable[[], object], repeats: int) -> list[str]:
    """Return the times of a step, natively and in PyTorch, and their ratio."""
    native, plain = [], []
    for _ in range(repeats):
        native += timed(step, 1)
        with in_pytorch():
            plain += timed(step, 1)
    return [median_and_spread(native), median_and_spread(plain), f"{median(plain) / median(native):.1f}"]


def _shape_step(config: ShapeConfig, count: int) -> Callable[[], object]:
    generator = torch.Generator().manual_seed(0)
    network = OccupancyNetwork(config, 3 * _JOINTS, torch.rand(24, 2, 3, generator=generator) - 0.5, _BOX)
    if network.grids is not None:
        network.grids.cover(torch.rand(8, 32, 32, generator=generator) > 0.7)
    points = (torch.rand(count, 3, generator=generator) * 2 - 1).requires_grad_()
    condition, pose = torch.randn(4, 3 * _JOINTS, generator=generator), torch.arange(count) % 4
    seen = torch.rand(count, _JOINTS, generator=generator)
    inputs = [points, *network.parameters()]
    return lambda: torch.autograd.grad(network(points, condition, pose, seen).sum(), inputs)


def _weights_step(count: int, depth: int) -> Callable[[], object]:
    field = NetworkWeights(PlainSoftmax(24), CanonicalGrid(*_BOX), 128, depth, 20.0, False)
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return lambda: torch.autograd.grad(field.at_fixed_points(points, keeps_prior=True).square().sum(), list(field.parameters()))


if __name__ == "__main__":
    main()
