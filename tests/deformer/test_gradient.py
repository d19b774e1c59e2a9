"""The implicit gradient against finite differences of the search itself."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer import SearchConfig, find_correspondences

SHAPE = (3, 4, 5)


@pytest.fixture
def scene():
    """Return points, transforms and logits of weights in float64, in a pose where each point has one root."""
    transforms = random_transforms(2, 3, 0.15)
    scores = smooth_weights(SHAPE, 3).log()
    weights = scores.softmax(-1)
    points = torch.stack([posed_queries(weights, pose, 3, seed)[0] for seed, pose in enumerate(transforms)])
    return points, transforms, scores


@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_gradcheck(scene, search):
    """To the query points, the bone transforms and (through a softmax, which keeps the sums at 1) the weights."""
    points, transforms, scores = (t.clone().requires_grad_() for t in scene)
    grid = unit_grid()

    def roots(p, upper, s):
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(2, 3, 1, 4)
        whole = torch.cat([upper, bottom], 2)
        weights = s.softmax(-1)
        return find_correspondences(
            p, whole, weights, grid, search=SearchConfig(search, tolerance=1e-13, max_steps=60)
        ).canonical

    upper = transforms.detach()[:, :, :3].clone().requires_grad_()
    assert roots(points, upper, scores).shape == (6, 3)
    assert torch.autograd.gradcheck(roots, (points, upper, scores), eps=1e-6, atol=1e-5)


def test_second_derivative_is_rejected(scene):
    points, transforms, scores = scene
    points = points.clone().requires_grad_()
    result = find_correspondences(points, transforms, scores.softmax(-1), unit_grid())
    (first,) = torch.autograd.grad(result.canonical.square().sum(), points, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivative of a correspondence search"):
        first.sum().backward()


def test_approximate_jacobian_is_near_but_not_equal(scene):
    points, transforms, scores = scene
    weights = scores.softmax(-1)
    exact = find_correspondences(points, transforms, weights, unit_grid(), search="broyden")
    rough = find_correspondences(points, transforms, weights, unit_grid(), search=SearchConfig("broyden", jacobian="broyden"))
    assert torch.equal(exact.canonical, rough.canonical)
    error = (exact.jacobian_inverse - rough.jacobian_inverse).norm() / exact.jacobian_inverse.norm()
    assert 1e-6 < error < 0.3


def test_no_gradient_is_tracked_without_need(scene):
    points, transforms, scores = scene
    assert not find_correspondences(points, transforms, scores.softmax(-1), unit_grid()).canonical.requires_grad
