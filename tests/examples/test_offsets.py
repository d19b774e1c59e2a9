"""The example with an offset: it learns, the known offset explains the scans, and the gradient is exact."""

from __future__ import annotations

import offsets
import pytest
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from snarfcli import ForwardDeformer, builtin_body


@pytest.fixture(scope="module")
def scene():
    """The true body in float64, the normals of its surface, poses, their transforms, and scanned points [2, 150, 3]."""
    torch.manual_seed(0)
    body = builtin_body(torch.float64)
    deformer = ForwardDeformer.from_body(body, resolution=[32, 32, 12])
    deformer.freeze()
    canonical = deformer.body
    normals = offsets.vertex_normals(canonical.vertices, body.faces)
    pose = offsets.random_poses(2).double()
    transforms = canonical.posed_from_canonical(pose)
    truth = offsets.SoftBody(deformer, offsets.Muscles(canonical))
    points = offsets.posed_vertices(truth, canonical.vertices[torch.randint(6890, (150,))], pose, transforms)
    return truth, normals, pose, transforms, points


def test_the_offset_is_learned():
    scans, arms = zip(*offsets.train(steps=13), strict=True)
    assert scans[-1] < 0.6 * scans[0]
    assert arms[-1] < 0.85 * arms[0]


def test_the_known_offset_puts_every_scanned_point_on_the_surface(scene):
    truth, normals, pose, transforms, points = scene
    found = truth.find(points, pose, transforms)
    distance = offsets.surface_distance(found.canonical, truth.deformer.body.vertices, normals).abs()
    nearest = found.minimum(distance, empty=1.0)
    assert float((nearest < 1e-6).double().mean()) > 0.99  # skinning alone has no root for a few points
    plain = offsets.SoftBody(truth.deformer, lambda x, pose: torch.zeros_like(x)).find(points, pose, transforms)
    distance = offsets.surface_distance(plain.canonical, truth.deformer.body.vertices, normals).abs()
    assert float(plain.minimum(distance, empty=1.0).max()) > 2e-3


def test_the_gradient_to_the_network_is_that_of_finite_differences(scene):
    truth, normals, pose, transforms, points = scene
    network = offsets.LearnedOffset().double()
    body = offsets.SoftBody(truth.deformer, network)

    def loss() -> torch.Tensor:
        found = body.find(points, pose, transforms)
        return offsets.surface_distance(found.canonical, truth.deformer.body.vertices, normals).square().sum()

    loss().backward()
    gradient = torch.cat([parameter.grad.flatten() for parameter in network.parameters()])
    start = parameters_to_vector(network.parameters()).detach()
    direction = torch.randn(len(start), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    values = []
    for step in (1e-6, -1e-6):
        vector_to_parameters(start + step * direction, network.parameters())
        values.append(loss().item())
    expected = (values[0] - values[1]) / 2e-6
    assert float(gradient @ direction) == pytest.approx(expected, rel=1e-4)
