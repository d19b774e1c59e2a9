"""The canonical occupancy network: its parts, initialisation and gradient."""

from __future__ import annotations

import pytest
import torch

from snarfcli.segments import distance_to_segments
from snarfcli.shape import OccupancyNetwork, ShapeConfig

BONES = torch.tensor([[[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], [[0.5, 0.0, 0.0], [0.5, 0.4, 0.0]]])
SMALL = {
    "width": 16, "depth": 3, "skip_layers": [2], "condition_layer": 1, "condition_size": 4, "frequencies": [2.0],
}  # fmt: skip


def points(count, seed=0, scale=1.0):
    return (torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 0.5) * 2 * scale


def test_distance_to_segments_by_dense_sampling():
    x = points(50)
    share = torch.linspace(0, 1, 2001)[:, None]
    dense = torch.cat([start + share * (end - start) for start, end in BONES])
    wanted = torch.cdist(x, dense).amin(1)
    torch.testing.assert_close(distance_to_segments(x, BONES), wanted, atol=2e-4, rtol=0)  # sampled every 0.25 mm
    inside = BONES[:1, 0] + torch.tensor([[0.2, 0.0, 0.0]])
    assert float(distance_to_segments(inside, BONES)) == pytest.approx(0, abs=1e-5)


def test_condition_enters_like_a_joined_input():
    """The per-pose bias equals joining the pose code to the layer's input, as the papers describe it."""
    torch.manual_seed(0)
    network = OccupancyNetwork(ShapeConfig(**SMALL), 6, BONES)
    x, condition = points(20), torch.randn(3, 6, generator=torch.Generator().manual_seed(1))
    pose = torch.arange(20) % 3
    code = network.pose_code(condition)[pose]
    angles = (x[:, None] * network.frequencies[:, None]).flatten(1)
    encoded = torch.cat([x, angles.sin(), angles.cos()], 1)
    h = torch.nn.functional.softplus(network.layers[0](encoded), beta=100)
    h = torch.nn.functional.softplus(network.layers[1](torch.cat([h, code], 1)), beta=100)
    h = torch.nn.functional.softplus(network.layers[2](torch.cat([h, encoded], 1) / 2**0.5), beta=100)
    torch.testing.assert_close(network(x, condition, pose), network.layers[3](h)[:, 0], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("frequencies", [[], [3.0, 30.0]])
def test_geometric_initialisation_is_about_a_sphere_of_one_metre(frequencies):
    torch.manual_seed(0)
    network = OccupancyNetwork(ShapeConfig(frequencies=frequencies), 0, BONES)
    directions = torch.nn.functional.normalize(points(200), dim=1)
    index = torch.zeros(200, dtype=torch.long)
    no_pose = torch.zeros(1, 0)
    assert float((network(0.6 * directions, no_pose, index) > 0).float().mean()) > 0.98
    assert float((network(1.5 * directions, no_pose, index) < 0).float().mean()) > 0.98


def test_prior_starts_as_capsules():
    torch.manual_seed(0)
    config = ShapeConfig(**SMALL | {"prior_radius_m": 0.07}, activation="relu", geometric_init=False, weight_norm=False)
    network = OccupancyNetwork(config, 6, BONES)
    x = points(2000, scale=0.7)
    inside = network(x, torch.zeros(1, 6), torch.zeros(2000, dtype=torch.long)) > 0
    distance = distance_to_segments(x, BONES)
    assert bool(inside[distance < 0.06].all())
    assert not bool(inside[distance > 0.08].any())


def test_pose_has_no_influence_at_the_start_if_switched_off():
    torch.manual_seed(0)
    config = ShapeConfig(**SMALL, condition_at_start=False, geometric_init=False, weight_norm=False)
    network = OccupancyNetwork(config, 6, BONES)
    x, poses = points(10), torch.randn(2, 6)
    first = network(x, poses, torch.zeros(10, dtype=torch.long))
    assert torch.equal(first, network(x, poses, torch.ones(10, dtype=torch.long)))
    first.sum().backward()
    assert float(network.layers[1].weight.grad[:, -4:].abs().sum()) > 0  # but it is learned


def test_gradcheck():
    torch.manual_seed(0)
    network = OccupancyNetwork(ShapeConfig(**SMALL), 6, BONES).double()
    x = points(4).double().requires_grad_()
    condition = torch.randn(2, 6, dtype=torch.float64, requires_grad=True)
    pose = torch.tensor([0, 1, 1, 0])
    assert torch.autograd.gradcheck(lambda a, b: network(a, b, pose), (x, condition))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"activation": "tanh"}, "shape.activation: wanted softplus or relu, got 'tanh'"),
        ({"condition_layer": 8}, "shape.condition_layer: wanted 0 to 7, got 8"),
    ],
)
def test_settings_that_make_no_network_are_rejected(change, message):
    with pytest.raises(ValueError, match=message):
        OccupancyNetwork(ShapeConfig(**change), 6, BONES)
