"""The readable complete search: the bounds of its memory, and cells that are cut. The other tests of both backends are in
test_search.py and test_native_search.py."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import random_transforms, scene, smooth_weights, unit_grid

from snarfcli.deformer import SearchConfig, blend_transforms, candidates, complete, find_correspondences
from snarfcli.deformer.grid import cell_corners
from snarfcli.deformer.posed_boxes import posed_cell_boxes

REFERENCE = SearchConfig(backend="reference")


@pytest.mark.parametrize("name", ["_QUERIES_AT_ONCE", "_CELLS_AT_ONCE", "_PAIRS_AT_ONCE"])
def test_what_is_processed_at_once_does_not_matter(monkeypatch, name):
    points, transforms, weights = scene(torch.float64, batch=3, count=200, angle=1.2)
    wanted = find_correspondences(points, transforms, weights, unit_grid(), search=REFERENCE)
    monkeypatch.setattr(complete, name, 37)
    found = find_correspondences(points, transforms, weights, unit_grid(), search=REFERENCE)
    assert torch.equal(found.query, wanted.query)
    torch.testing.assert_close(found.canonical, wanted.canonical, atol=1e-9, rtol=0)
    assert int(wanted.query.bincount().max()) > 3


def test_both_backends_find_the_same_in_the_same_order():
    points, transforms, weights = scene(torch.float64, batch=3, count=1000, angle=1.2)
    native, reference = (
        find_correspondences(points, transforms, weights, unit_grid(), search=SearchConfig(backend=backend))
        for backend in ("native", "reference")
    )
    assert torch.equal(native.query, reference.query)
    # Beside a fold both roots are only as exact as the square root of the residual.
    torch.testing.assert_close(native.canonical, reference.canonical, atol=1e-6, rtol=0)
    assert bool((torch.linalg.det(reference.jacobian_inverse) < 0).any())


def test_cells_that_collapse_take_bounded_memory(monkeypatch):
    """All cells on one point, all queries there: every pair is a candidate and none of the eighths can be ruled out."""
    largest = 0
    evaluate = complete.evaluate

    def watch(polynomials, local):
        nonlocal largest
        largest = max(largest, local.shape[1])
        return evaluate(polynomials, local)

    for module, name in ((candidates, "_PAIRS_AT_ONCE"), (complete, "_PAIRS_AT_ONCE")):
        monkeypatch.setattr(module, name, 64)
    monkeypatch.setattr(complete, "evaluate", watch)
    monkeypatch.setattr(complete, "_LEVELS", 1)
    transforms = torch.zeros(1, 1, 4, 4, dtype=torch.float64)
    transforms[..., 3, 3] = 1
    nodes = torch.ones(2, 3, 3, 1, dtype=torch.float64)
    found = find_correspondences(
        torch.zeros(1, 40, 3, dtype=torch.float64), transforms, nodes, unit_grid(), search=REFERENCE, check=False
    )
    assert not len(found.query)
    assert largest == 64


def test_boxes_contain_the_posed_nodes():
    shape, grid = (3, 4, 5), unit_grid()
    nodes, weights = grid.nodes(shape).reshape(-1, 3), smooth_weights(shape, 4)
    transforms = blend_transforms(weights, random_transforms(1, 4, 1.0))[0].reshape(-1, 3, 4)
    posed = (transforms[..., :3] @ nodes[..., None])[..., 0] + transforms[..., 3]
    corners = cell_corners(torch.arange(24), shape)
    lower, upper = posed_cell_boxes(transforms.reshape(-1, 12)[corners], nodes[corners[:, 0]], grid.cell_size(shape))
    assert bool((posed[corners] >= lower[:, None]).all())
    assert bool((posed[corners] <= upper[:, None]).all())
    assert float((upper - lower).max()) < 3
