"""The example with betas: it learns, and the samples of a batch have weights and gradients of their own."""

from __future__ import annotations

import pytest
import subjects
import torch

from snarfcli import builtin_body


@pytest.fixture(scope="module")
def scene():
    """A model, betas [3, S], and points, distances and bone transforms of a batch."""
    torch.manual_seed(0)
    body = builtin_body()
    betas = torch.randn(3, body.num_betas)
    canonical = torch.stack([subjects.canonical_vertices(body, shape) for shape in [*betas, torch.zeros(0)]])
    chosen = torch.randint(len(body.weights), (500,))
    return subjects.make_model(body, canonical), betas, subjects.scan(body, betas, chosen)


def test_shape_and_weights_are_learned():
    history = subjects.train(steps=13)
    first, last = history[0], history[-1]
    assert last["loss"] < 0.85 * first["loss"]
    assert last["weights"] < 0.6 * first["weights"]
    assert last["warp in mm"] < 0.6 * first["warp in mm"]


def test_a_sample_does_not_depend_on_the_others(scene):
    model, betas, (points, _, transforms) = scene
    with torch.no_grad():
        together = model(points, betas, transforms)
        alone = torch.cat([model(points[b : b + 1], betas[b : b + 1], transforms[b : b + 1]) for b in range(3)])
        others = model(points, betas.roll(1, 0), transforms)
    assert float((together - alone).abs().max()) < 1e-5
    assert float((together - others).abs().max()) > 1e-2  # the betas matter


def test_the_union_alone_trains_the_warp_through_the_roots_and_the_weights(scene):
    model, betas, (points, _, transforms) = scene
    model.zero_grad()
    betas = betas.clone().requires_grad_()
    model(points, betas, transforms)[1].sum().backward()
    assert all(float(parameter.grad.norm()) > 0 for parameter in model.warp.parameters())
    assert betas.grad is not None
    assert betas.grad[[0, 2]].abs().sum() == 0  # the other samples have no part in it
    assert betas.grad[1].norm() > 0


def test_most_points_inside_the_scan_have_a_root(scene):
    model, betas, (points, distance, transforms) = scene
    model.weights.betas = betas
    found = model.deformer(points, transforms).found
    assert float(found[distance < 0].float().mean()) > 0.99
