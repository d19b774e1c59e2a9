"""The example with rays: it learns, and its gradients, normals and pictures are right."""

from __future__ import annotations

from functools import partial

import pytest
import rays
import torch
from torch import Tensor

from snarfcli import ForwardDeformer, builtin_body
from snarfcli.bodies import axis_angle_to_matrix


@pytest.fixture(scope="module")
def deformer() -> ForwardDeformer:
    return ForwardDeformer.from_body(builtin_body(), resolution=[32, 32, 12])


def posed_by(deformer: ForwardDeformer, pose: Tensor):
    return deformer.pose(builtin_body().skeleton().posed_from_canonical(pose))


def known_field():
    return partial(rays.known_field, bones=rays.points_on_bones(builtin_body().skeleton()))


def some_rays(count: int) -> tuple[Tensor, Tensor]:
    chosen = torch.randperm(rays.SIZE**2, generator=torch.Generator().manual_seed(0))[:count]
    origins, directions = rays.cameras(torch.tensor([0.4]), torch.tensor([0.0, -0.3, 0.0]))
    return origins[:, chosen], directions[:, chosen]


def test_the_field_and_the_poses_are_learned():
    history = rays.train(steps=13, rays=256)
    errors, angles = zip(*history, strict=True)
    assert errors[-1] < 0.6 * errors[0]
    assert angles[-1] < angles[0] - 0.5


def test_chunks_give_the_gradient_of_one_call(deformer, monkeypatch):
    field, view = known_field(), some_rays(300)

    def gradient(chunk: int) -> Tensor:
        monkeypatch.setattr(rays, "CHUNK", chunk)
        pose = torch.zeros(1, 24, 3)
        pose[0, 18, 1] = -1.0
        pose.requires_grad_()
        rays.render(posed_by(deformer, pose), field, *view).square().sum().backward()
        assert pose.grad is not None
        return pose.grad

    whole, parts = gradient(10_000), gradient(700)
    assert whole.norm() > 1e-2
    assert (whole - parts).norm() < 1e-4 * whole.norm()  # fp32, sums in another order


def test_normals_turn_with_the_body(deformer):
    """Turning the root alone moves the whole body rigidly."""
    pose = torch.zeros(1, 24, 3)
    field = known_field()
    points = torch.rand(1, 5000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.5, 0.3])
    points = points - torch.tensor([0.5, 1.0, 0.15])
    distance, colour, normal = (part.detach() for part in rays.query(posed_by(deformer, pose), field, points))
    assert int((distance < 0).sum()) > 200
    pose[0, 0] = torch.tensor([0.3, 0.8, -0.4])
    turn = axis_angle_to_matrix(pose[:, 0])[0]
    joint = builtin_body().skeleton().joints_rest[0]
    turned = [part.detach() for part in rays.query(posed_by(deformer, pose), field, (points - joint) @ turn.T + joint)]
    rooted = (distance < 0.1) & (turned[0] < 0.1)
    assert float((turned[0] - distance)[rooted].abs().max()) < 1e-4
    assert float((turned[1] - colour)[rooted].abs().max()) < 1e-3
    # The nearest point on the bones, and with it the normal, jumps at a few places.
    assert float((turned[2] - normal @ turn.T)[rooted].norm(dim=1).quantile(0.99)) < 1e-3


def test_a_ray_beside_the_body_sees_nothing(deformer):
    posed = posed_by(deformer, torch.zeros(1, 24, 3))
    origins = torch.tensor([[[0.0, -0.2, 4.0], [0.0, 3.0, 4.0]]])
    directions = torch.tensor([[[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]]])
    seen = rays.render(posed, known_field(), origins, directions)[0].detach()
    assert float(seen[0].sum()) > 0.1
    assert torch.equal(seen[1], torch.zeros(3))
