"""Both correspondence searches against an exhaustive one, and their edges."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import exhaustive_roots, move, posed_queries, random_transforms, smooth_weights, unit_grid

from snarfcli.deformer import SearchConfig, find_correspondences

SHAPE = (6, 7, 8)


def same_roots(found, truth):
    """Return how many of the true roots [K, 3] are among the found ones [M, 3], and whether nothing else is."""
    if not len(truth):
        return 0, not len(found)
    distance = torch.cdist(truth, found) if len(found) else torch.ones(len(truth), 1)
    hits = int((distance.amin(1) < 1e-5).sum())
    return hits, bool((torch.cdist(found, truth).amin(1) < 1e-5).all()) if len(found) else True


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize(("bones", "angle"), [(2, 0.3), (2, 1.2), (24, 0.5), (55, 0.4)])
def test_complete_search_finds_what_exhaustive_search_finds(bones, angle, backend):
    grid, weights = unit_grid(), smooth_weights(SHAPE, bones)
    transforms = random_transforms(1, bones, angle)
    points, _ = posed_queries(weights, transforms[0], 40)
    search = SearchConfig(max_steps=20, backend=backend)
    result = find_correspondences(points[None], transforms, weights, grid, search=search)
    truth = exhaustive_roots(points, weights, transforms[0], grid)
    total = 0
    for q, roots in enumerate(truth):
        mine = result.canonical[result.query == q]
        found, nothing_else = same_roots(mine, roots)
        assert nothing_else, f"query {q} has a root that is none"
        assert len(mine) == found == len(roots), f"query {q} lacks a root or has one twice"
        total += len(roots)
    assert total >= 40  # every query was made from a canonical point


def test_complete_search_returns_the_point_it_came_from():
    grid, weights = unit_grid(torch.float32), smooth_weights(SHAPE, 5, dtype=torch.float32)
    transforms = random_transforms(3, 5, 0.25, dtype=torch.float32)
    pairs = [posed_queries(weights, pose, 500, seed) for seed, pose in enumerate(transforms)]
    points = torch.stack([posed for posed, _ in pairs])
    canonical = torch.stack([point for _, point in pairs]).reshape(-1, 3)
    result = find_correspondences(points, transforms, weights, grid)
    # Largest error seen 2e-6 m (float32, coordinates up to 1.5 m); the mild poses have one root a query.
    nearest = torch.full((1500,), 1.0).scatter_reduce(
        0, result.query, (result.canonical - canonical[result.query]).norm(dim=1), "amin"
    )
    assert float((nearest < 2e-5).float().mean()) == 1.0


@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_every_root_solves_the_equation_and_its_jacobian_is_exact(search):
    grid, weights = unit_grid(), smooth_weights(SHAPE, 6)
    transforms = random_transforms(2, 6, 0.6)
    points = torch.stack([posed_queries(weights, pose, 200, 3)[0] for pose in transforms])
    result = find_correspondences(points, transforms, weights, grid, search=SearchConfig(search, tolerance=1e-7, max_steps=30))
    assert len(result.query) > 100
    for b in range(2):
        mine = result.pose == b
        canonical = result.canonical[mine]
        residual = move(canonical, weights, transforms[b], grid) - points[b][result.query[mine] - 200 * b]
        assert residual.norm(dim=1).max() < 1e-6
        inside = ((canonical > grid.lower + 1e-3) & (canonical < grid.upper - 1e-3)).all(1)
        steps = 1e-6 * torch.eye(3, dtype=torch.float64)
        ahead = [move(canonical + s, weights, transforms[b], grid) for s in steps]
        behind = [move(canonical - s, weights, transforms[b], grid) for s in steps]
        columns = [(front - back) / 2e-6 for front, back in zip(ahead, behind, strict=True)]
        product = torch.bmm(torch.stack(columns, 2), result.jacobian_inverse[mine])
        # Roots within a step of a cell's face see two different Jacobians in the difference; they are rare.
        error = (product - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2))[inside]
        assert float((error < 1e-3).double().mean()) > 0.99


def test_broyden_roots_are_among_the_complete_ones():
    grid, weights = unit_grid(), smooth_weights(SHAPE, 6)
    transforms = random_transforms(1, 6, 0.5)
    points, _ = posed_queries(weights, transforms[0], 300)
    complete = find_correspondences(points[None], transforms, weights, grid)
    broyden = find_correspondences(
        points[None], transforms, weights, grid, search=SearchConfig("broyden", tolerance=1e-6, max_steps=50)
    )
    known = [
        bool(((complete.canonical[complete.query == query] - root).norm(dim=1) < 2e-4).any())
        for root, query in zip(broyden.canonical, broyden.query, strict=True)
    ]
    assert len(known) > 250
    assert all(known)  # beside a fold, a residual of 1e-6 m leaves Broyden's root 1e-4 m off
    few = find_correspondences(points[None], transforms, weights, grid, search=SearchConfig("broyden", init_bones=[0]))
    assert len(few.query) < len(broyden.query)


def test_result_does_not_depend_on_the_batch():
    grid, weights = unit_grid(torch.float32), smooth_weights(SHAPE, 4, dtype=torch.float32)
    transforms = random_transforms(3, 4, 0.5, dtype=torch.float32)
    points = torch.stack([posed_queries(weights, pose, 100)[0] for pose in transforms])
    together = find_correspondences(points, transforms, weights, grid)
    for b in range(3):
        alone = find_correspondences(points[b : b + 1], transforms[b : b + 1], weights, grid)
        assert torch.equal(together.canonical[together.pose == b], alone.canonical)
        assert torch.equal(together.query[together.pose == b] - 100 * b, alone.query)
    assert bool((together.query.diff() >= 0).all())


def test_one_rigid_bone_is_inverted_rigidly():
    grid = unit_grid()
    weights = torch.ones(3, 3, 3, 1, dtype=torch.float64)
    transforms = random_transforms(1, 1, 1.5)
    points, canonical = posed_queries(weights, transforms[0], 100)
    for search in ("complete", "broyden"):
        result = find_correspondences(points[None], transforms, weights, grid, search=search)
        assert torch.equal(result.query, torch.arange(100))  # roots on faces come once
        torch.testing.assert_close(result.canonical, canonical, atol=1e-9, rtol=0)


def test_scaled_bones_are_inverted_and_not_transposed():
    grid = unit_grid()
    weights = torch.ones(3, 3, 3, 1, dtype=torch.float64)
    transforms = random_transforms(1, 1, 0.7)
    transforms[..., :3, :3] *= 1.7
    points, canonical = posed_queries(weights, transforms[0], 50)
    for search in ("complete", "broyden"):
        result = find_correspondences(points[None], transforms, weights, grid, search=search)
        torch.testing.assert_close(result.canonical, canonical, atol=1e-9, rtol=0)


def test_overlapping_parts_give_several_roots():
    """Two halves that are pushed into each other: points of the overlap have one root in either half."""
    grid, weights = unit_grid(), torch.zeros(5, 5, 9, 2, dtype=torch.float64)
    weights[:, :, :5, 0] = 1.0
    weights[:, :, 5:, 1] = 1.0
    transforms = torch.eye(4, dtype=torch.float64).repeat(1, 2, 1, 1)
    transforms[0, 1, 0, 3] = -0.8
    point = torch.tensor([[[-0.3, 0.0, 0.0]]], dtype=torch.float64)
    result = find_correspondences(point, transforms, weights, grid)
    x = result.canonical[:, 0].sort().values
    assert x[0] == pytest.approx(-0.3)
    assert x[-1] == pytest.approx(0.5)
    roots, mask = result.padded()
    assert roots.shape[:3] == mask.shape
    assert int(mask.sum()) == len(x)


@pytest.mark.parametrize("search", ["complete", "broyden"])
def test_points_that_nothing_is_moved_onto(search):
    grid, weights = unit_grid(), smooth_weights(SHAPE, 3)
    transforms = random_transforms(2, 3, 0.2)
    points = torch.full((2, 4, 3), 50.0, dtype=torch.float64)
    points[0, 1] = float("nan")
    points[1, 2] = float("inf")
    points[0, 3] = posed_queries(weights, transforms[0], 1)[0][0]
    result = find_correspondences(points, transforms, weights, grid, search=search)
    assert result.query.tolist() == [3]
    assert result.found.tolist() == [[False, False, False, True], [False] * 4]
    assert result.maximum(torch.tensor([7.0], dtype=torch.float64), -1.0)[0].tolist() == [-1.0, -1.0, -1.0, 7.0]


@pytest.mark.parametrize("search", ["complete", "broyden"])
@pytest.mark.parametrize(("batch", "count"), [(0, 5), (2, 0), (0, 0)])
def test_nothing_to_search(search, batch, count):
    grid, weights = unit_grid(), smooth_weights(SHAPE, 3)
    points = torch.zeros(batch, count, 3, dtype=torch.float64)
    result = find_correspondences(points, random_transforms(batch, 3, 0.2), weights, grid, search=search)
    assert result.canonical.shape == (0, 3)
    assert result.found.shape == (batch, count)
    assert result.padded()[0].shape[:2] == (batch, count)


def test_only_active_cells_are_searched():
    grid, weights = unit_grid(), smooth_weights(SHAPE, 3)
    transforms = random_transforms(1, 3, 0.2)
    points, canonical = posed_queries(weights, transforms[0], 200)
    active = torch.zeros(5, 6, 7, dtype=torch.bool)
    assert not len(find_correspondences(points[None], transforms, weights, grid, active_cells=active).query)
    active[:, :, :3] = True
    border = grid.lower[0] + 3 * grid.cell_size(SHAPE)[0]
    result = find_correspondences(points[None], transforms, weights, grid, active_cells=active)
    assert result.canonical[:, 0].max() <= border + 1e-4
    expected = (canonical[:, 0] < border).sum()
    assert len(result.query.unique()) == expected


WRONG = {
    "points": (lambda a: a | {"points": torch.zeros(4, 3)}, ValueError, r"points: wanted shape \[B, N, 3\], got \[4, 3\]"),
    "bones": (
        lambda a: a | {"bone_transforms": torch.zeros(1, 2, 4, 4)},
        ValueError,
        r"bone_transforms: wanted shape \[1, 3, 4, 4\] to fit the others, got \[1, 2, 4, 4\]",
    ),
    "weights": (lambda a: a | {"skinning_weights": torch.zeros(1, 4, 4, 3)}, ValueError, "skinning_weights: wanted shape"),
    "integers": (lambda a: a | {"points": torch.zeros(1, 4, 3, dtype=torch.int64)}, TypeError, "points: wanted float32 or"),
    "mixed": (lambda a: a | {"points": torch.zeros(1, 4, 3).double()}, TypeError, "wanted the dtype of points"),
    "search": (lambda a: a | {"search": "newton"}, ValueError, "search.name: wanted complete or broyden, got 'newton'"),
    "init": (
        lambda a: a | {"search": SearchConfig("broyden", [3])},
        ValueError,
        r"search.init_bones: wanted bones from 0 to 2, got \[3\]",
    ),
    "no init": (lambda a: a | {"search": SearchConfig("broyden", [])}, ValueError, "at least one bone"),
    "active": (lambda a: a | {"active_cells": torch.ones(3, 3, 3)}, ValueError, r"active_cells: wanted bool \[5, 6, 7\]"),
    "jacobian": (
        lambda a: a | {"search": SearchConfig(jacobian="broyden")},
        ValueError,
        "search.jacobian 'broyden' needs search.name 'broyden'",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_named(case):
    good = {
        "points": torch.zeros(1, 4, 3),
        "bone_transforms": torch.eye(4).repeat(1, 3, 1, 1),
        "skinning_weights": smooth_weights(SHAPE, 3, dtype=torch.float32),
        "grid": unit_grid(torch.float32),
    }
    change, error, message = WRONG[case]
    with pytest.raises(error, match=message):
        find_correspondences(**change(good))
