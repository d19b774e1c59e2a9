"""The occupancy network as one operator: what PyTorch asks of operators, and where it runs its readable version."""

from __future__ import annotations

import pytest
import torch

from snarfcli.native.cuda_network import NetworkArrays
from snarfcli.networks.occupancy import occupancy, occupancy_reference
from snarfcli.shape import OccupancyNetwork, ShapeConfig
from snarfcli.shape.inference import occupancy_arguments

CONFIG = ShapeConfig(width=16, depth=2, skip_layers=[1], frequencies=[2.0], condition_layer=1, prior_radius_m=0.1)


@torch.no_grad()
def arguments(seen: bool = False) -> list:
    torch.manual_seed(0)
    network = OccupancyNetwork(CONFIG, 12, torch.rand(3, 2, 3)).requires_grad_(False)
    shares = torch.rand(9, 4) if seen else None
    return list(occupancy_arguments(network, torch.rand(9, 3), torch.randn(2, 12), torch.arange(9) % 2, shares))


@pytest.mark.parametrize("seen", [False, True])
def test_operator_passes_pytorch_s_checks(seen):
    torch.library.opcheck(occupancy, (*arguments(seen), "highest"))


@torch.no_grad()
def test_reference_multiplies_in_the_precision():
    arrays = NetworkArrays(*arguments())
    exact = occupancy_reference(arrays, "highest")
    off = (occupancy_reference(arrays, "bfloat16") - exact).abs().max()
    assert exact.dtype == torch.float32
    assert 1e-4 < float(off) < 0.1
