"""Time to evaluate the canonical occupancy network without gradients: natively, and layer by layer in PyTorch.

    python benchmarks/bm_shape.py

Untrained networks of the sizes of the papers and of shape=small, with global and local pose condition.
"""

from __future__ import annotations

import torch
from common import arguments, in_pytorch, print_machine, print_table, timed

from snarfcli.precision import network_precision
from snarfcli.shape import OccupancyNetwork, ShapeConfig
from snarfcli.shape.inference import evaluate

_JOINTS = 23
_SIZES = {
    "papers': 8 x 256, softplus": ShapeConfig(),
    "small: 6 x 128, ReLU, waves, capsules": ShapeConfig(
        width=128, depth=6, activation="relu", skip_layers=[], frequencies=[2.0, 4.0, 8.0, 16.0], condition_layer=2,
        condition_size=16, geometric_init=False, weight_norm=False, prior_radius_m=0.07,
    ),
}  # fmt: skip


def main() -> None:
    options = arguments("Shape network.", points={"type": int, "default": 32_768, "help": "points in one call"})
    print_machine()
    rows = []
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(options.points, 3, generator=generator) * 2 - 1
    condition, pose = torch.randn(1, 3 * _JOINTS, generator=generator), torch.zeros(options.points, dtype=torch.long)
    for name, config in _SIZES.items():
        network = OccupancyNetwork(config, 3 * _JOINTS, torch.rand(24, 2, 3, generator=generator) - 0.5)
        for kind in ("global", "local"):
            seen = None if kind == "global" else torch.rand(options.points, _JOINTS, generator=generator)
            inputs = (points, condition, pose, seen)
            with torch.no_grad():
                native = min(timed(lambda n=network, i=inputs: evaluate(n, *i), options.repeats))
                with in_pytorch():
                    plain = min(timed(lambda n=network, i=inputs: n(*i), options.repeats))
                with in_pytorch(), network_precision("medium", points.device):
                    medium = min(timed(lambda n=network, i=inputs: n(*i), options.repeats))
            rows.append([name, kind, f"{1e3 * native:.1f}", *(f"{1e3 * t:.1f} ({t / native:.1f} x)" for t in (plain, medium))])
    header = ["network", "condition", f"native, ms for {options.points:,} points", "PyTorch", 'PyTorch, precision "medium"']
    print_table(header, rows)


if __name__ == "__main__":
    main()
