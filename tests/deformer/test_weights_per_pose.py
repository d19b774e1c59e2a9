"""Skinning weights that differ from pose to pose, on a grid: as if each pose were searched alone, with exact gradients."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer import SearchConfig, blend_transforms, find_correspondences

SHAPE = (6, 7, 8)
SEARCHES = [(name, backend) for name in ("complete", "broyden") for backend in ("native", "reference")]


def scene(dtype=torch.float64, batch=3, count=40, bones=4, shape=SHAPE, angle=0.3):
    """Return points [B, N, 3] with roots, transforms, and weights [B, D, H, W, J] of another field for each pose."""
    weights = torch.stack([smooth_weights(shape, bones, seed, dtype) for seed in range(batch)])
    transforms = random_transforms(batch, bones, angle, dtype=dtype)
    points = torch.stack([posed_queries(w, pose, count, 1)[0] for w, pose in zip(weights, transforms, strict=True)])
    return points, transforms, weights


@pytest.mark.parametrize(("name", "backend"), SEARCHES)
def test_each_pose_is_searched_with_its_own_weights(name, backend):
    points, transforms, weights = scene()
    search = SearchConfig(name, backend=backend)
    together = find_correspondences(points, transforms, weights, unit_grid(), search=search)
    alone = [
        find_correspondences(points[b : b + 1], transforms[b : b + 1], weights[b], unit_grid(), search=search) for b in range(3)
    ]
    assert len(together.query) > 100
    assert torch.equal(together.query, torch.cat([one.query + 40 * b for b, one in enumerate(alone)]))
    assert torch.equal(together.canonical, torch.cat([one.canonical for one in alone]))
    assert torch.equal(together.jacobian_inverse, torch.cat([one.jacobian_inverse for one in alone]))


@pytest.mark.parametrize("name", ["complete", "broyden"])
def test_equal_weights_in_all_poses_are_the_same_as_shared_ones(name):
    points, transforms, weights = scene()
    shared = find_correspondences(points, transforms, weights[0], unit_grid(), search=name)
    repeated = find_correspondences(points, transforms, weights[:1].expand(3, -1, -1, -1, -1), unit_grid(), search=name)
    assert torch.equal(shared.canonical, repeated.canonical)


def test_only_the_weights_of_active_cells_count():
    points, transforms, weights = scene()
    active = torch.zeros([n - 1 for n in SHAPE], dtype=torch.bool)
    active[:, :, :3] = True
    everywhere = find_correspondences(points, transforms, weights, unit_grid())
    weights[1, :, :, 5:] = 0  # nodes that no active cell has
    some = find_correspondences(points, transforms, weights, unit_grid(), active_cells=active)
    border = unit_grid().lower[0] + 3 * unit_grid().cell_size(SHAPE)[0]
    assert torch.equal(some.canonical, everywhere.canonical[everywhere.canonical[:, 0] < border])
    weights[1, 0, 0, 0] = 0
    with pytest.raises(ValueError, match="skinning_weights: wanted a sum of 1 at every node of a searched cell, got 0"):
        find_correspondences(points, transforms, weights, unit_grid(), active_cells=active)


@pytest.mark.parametrize("name", ["complete", "broyden"])
def test_gradcheck(name):
    """To the points, the transforms and the weights of every pose."""
    points, transforms, weights = scene(batch=2, count=3, bones=3, shape=(3, 4, 5), angle=0.15)

    def roots(points, upper, scores):
        bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(2, 3, 1, 4)
        search = SearchConfig(name, tolerance=1e-13, max_steps=60)
        whole = torch.cat([upper, bottom], 2)
        return find_correspondences(points, whole, scores.softmax(-1), unit_grid(), search=search).canonical

    inputs = points, transforms[:, :, :3].clone(), weights.log()
    assert roots(*inputs).shape == (6, 3)
    assert torch.autograd.gradcheck(roots, tuple(x.requires_grad_() for x in inputs), eps=1e-6, atol=1e-5, fast_mode=True)


def test_blending_of_each_pose():
    _, transforms, weights = scene()
    rows = transforms[:, :, :3].reshape(3, -1, 12)
    expected = torch.stack([w.reshape(-1, 4) @ row for w, row in zip(weights, rows, strict=True)])
    torch.testing.assert_close(blend_transforms(weights, transforms), expected, atol=1e-14, rtol=0)
    empty = torch.empty(0, *weights.shape[1:], dtype=torch.float64, requires_grad=True)
    nothing = blend_transforms(empty, transforms[:0])
    assert nothing.shape == (0, 336, 12)
    nothing.sum().backward()
    assert empty.grad.shape == empty.shape


def test_an_empty_batch_and_compilation():
    points, transforms, weights = scene()
    empty = find_correspondences(points[:0], transforms[:0], weights[:0], unit_grid())
    assert empty.canonical.shape == (0, 3)
    grid = unit_grid()

    def run(points, transforms, weights):
        return find_correspondences(points, transforms, weights, grid, capacity=200).canonical

    compiled = torch.compile(run, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(points, transforms, weights), run(points, transforms, weights))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w[:2], r"skinning_weights: wanted shape \[3, D, H, W, J\] to fit points, got \[2, 6, 7, 8, 4\]"),
        (
            lambda w: w[None],
            r"skinning_weights: wanted shape \[D, H, W, J\], at least 2 nodes per side, got \[1, 3, 6, 7, 8, 4\]",
        ),
        (
            lambda w: w[:, :1],
            r"skinning_weights: wanted shape \[D, H, W, J\], at least 2 nodes per side, got \[3, 1, 7, 8, 4\]",
        ),
        (lambda w: w[..., :3], r"bone_transforms: wanted shape \[3, 3, 4, 4\] to fit the others, got \[3, 4, 4, 4\]"),
        (lambda w: 0.7 * w, "skinning_weights: wanted a sum of 1 at every node of a searched cell, got 0.7"),
    ],
)
def test_weights_that_do_not_fit_are_named(change, message):
    points, transforms, weights = scene()
    with pytest.raises(ValueError, match=message):
        find_correspondences(points, transforms, change(weights), unit_grid())
