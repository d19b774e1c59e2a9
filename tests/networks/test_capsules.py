"""The distance to the nearest segment: the native kernel against the readable version."""

from __future__ import annotations

import pytest
import torch

from snarfcli.networks import run_segment_distance
from snarfcli.networks.capsules import nearest_segment
from snarfcli.segments import distance_to_segments


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 700])
def test_distances_and_gradients_are_those_of_the_reference(count):
    generator = torch.Generator().manual_seed(0)
    segments = torch.rand(9, 2, 3, generator=generator)
    segments[3, 1] = segments[3, 0]  # a point
    points = (2 * torch.rand(count, 3, generator=generator) - 0.5).requires_grad_()
    wide = points.detach().double().requires_grad_()
    distance, wanted = run_segment_distance(points, segments), distance_to_segments(wide, segments.double())
    torch.testing.assert_close(distance.double(), wanted, rtol=0, atol=1e-6)
    gradient = torch.randn(count, generator=generator)
    (found,) = torch.autograd.grad(distance, points, gradient)
    (right,) = torch.autograd.grad(wanted, wide, gradient.double())
    torch.testing.assert_close(found.double(), right, rtol=0, atol=2e-5)


def test_operator_contract():
    segments = torch.rand(4, 2, 3)
    torch.library.opcheck(nearest_segment, (torch.rand(5, 3), segments))
    torch.library.opcheck(nearest_segment, (torch.rand(5, 3).requires_grad_(), segments))
