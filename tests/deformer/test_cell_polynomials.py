"""Polynomials of cells against the skinning that they stand for, and their bounds against samples of cells."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import move, random_transforms, smooth_weights, unit_grid
from torch.func import jacrev, vmap

from snarfcli.deformer import blend_transforms
from snarfcli.deformer.cell_polynomials import bound_boxes, bound_roots, cell_polynomials, cut_cells, evaluate, inverse_of, pick
from snarfcli.deformer.grid import CORNERS, cell_corners

SHAPE = (3, 4, 5)
CELLS = 24


def cells(angle: float, dtype=torch.float64):
    """Return polynomials of all cells of a grid, their canonical centres [3, C], and a function that skins points [N, 3]."""
    grid, weights = unit_grid(dtype), smooth_weights(SHAPE, 4, dtype=dtype)
    poses = random_transforms(1, 4, angle, 2, dtype)
    corners = cell_corners(torch.arange(CELLS), SHAPE)
    centres = (grid.nodes(SHAPE).reshape(-1, 3)[corners[:, 0]] + grid.cell_size(SHAPE) / 2).T
    polynomials = cell_polynomials(blend_transforms(weights, poses)[0, corners], centres, grid.cell_size(SHAPE))
    return polynomials, centres, lambda points: move(points, weights, poses[0], grid)


def local_points(count: int, side: float = 1.0, dtype=torch.float64):
    """Return cell coordinates [3, count, CELLS] of random points in cells."""
    return side * (torch.rand(3, count, CELLS, generator=torch.Generator().manual_seed(0), dtype=dtype) - 0.5)


def of_all(polynomials, local):
    """Evaluate at [3, K, C]."""
    count = local.shape[1]
    found = evaluate(polynomials.repeat(1, 1, 1, 1, count), local.flatten(1))
    return [part.unflatten(1, (count, -1)) for part in found]


def test_they_are_the_skinning_inside_cells():
    polynomials, centres, skin = cells(1.0)
    local = local_points(20)
    canonical = centres[:, None] + unit_grid().cell_size(SHAPE)[:, None, None] * local
    posed, *_ = of_all(polynomials, local)
    torch.testing.assert_close(posed.flatten(1).T, skin(canonical.flatten(1).T), atol=1e-12, rtol=0)


def test_derivatives_are_those_of_the_values():
    polynomials, _, _ = cells(1.0)
    local = local_points(1)[:, 0]
    _, *derivatives = evaluate(polynomials, local)

    def value(polynomial, at):
        return evaluate(polynomial[..., None], at[:, None])[0][:, 0]

    wanted = vmap(jacrev(value, 1), (4, 1), 2)(polynomials, local)
    torch.testing.assert_close(torch.stack(derivatives, 1), wanted)


def test_eighths_are_parts_of_their_cells():
    polynomials, _, _ = cells(1.0)
    parts = cut_cells(polynomials)
    for k in range(8):
        shift = torch.tensor([0.25 if k >> axis & 1 else -0.25 for axis in range(3)]).double()[:, None, None]
        local = local_points(5)
        torch.testing.assert_close(of_all(parts[..., k, :], local)[0], of_all(polynomials, shift + local / 2)[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 2])
def test_bounds_hold_in_all_cells(level, dtype):
    """For the posed image, for the roots of queries, and for how far d differs from its linear part between two points."""
    polynomials, _, _ = cells(1.0, dtype)
    for _ in range(level):
        polynomials = cut_cells(polynomials)[..., 5, :]
    first, second = local_points(1000, dtype=dtype), local_points(1000, dtype=dtype).flip(1)
    first[:, :8] = (CORNERS.to(dtype) - 0.5).T[..., None]
    (a, *_), (b, *_) = of_all(polynomials, first), of_all(polynomials, second)
    offset = a - polynomials[0, 0, 0][:, None]
    box = bound_boxes(polynomials, level)
    assert bool((offset.abs() <= box[:, None]).all())
    assert bool((offset.abs().amax(1) > 0.3 * box).all())  # not needlessly large
    bounds = bound_roots(polynomials, level)
    to_cell = bounds.inverse[:, :, None]
    assert bool(((to_cell * offset).sum(1).abs() <= bounds.reach[:, None]).all())
    curved = ((to_cell * (a - b)).sum(1) - (first - second)).abs().amax(0)
    slack = 1e-5 if dtype == torch.float32 else 1e-12
    assert bool((curved <= bounds.curvature * (first - second).abs().amax(0) + slack).all())
    assert 0.1 < float(bounds.curvature.median()) < 10


def test_a_cell_without_an_inverse_has_no_bounds():
    polynomials, _, _ = cells(0.5)
    polynomials[..., 0, 3] = polynomials[..., 1, 3]  # flat: two components are the same
    polynomials[..., 4] = 0
    bounds = bound_roots(polynomials)
    flat = torch.tensor([3, 4])
    assert not bool(bounds.inverse[..., flat].any())
    assert bool(bounds.reach[:, flat].isinf().all())
    assert bool(bounds.curvature[flat].isinf().all())
    assert bool(bounds.curvature[:3].isfinite().all())


def test_inverses_are_inverses():
    columns = torch.randn(3, 3, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inverse, determinant = inverse_of(*columns)
    matrices = columns.permute(2, 1, 0)
    torch.testing.assert_close(inverse.permute(2, 0, 1), torch.linalg.inv(matrices))
    torch.testing.assert_close(determinant, torch.linalg.det(matrices))


@pytest.mark.parametrize("shape", [(5,), (3, 5), (2, 3, 4, 5)])
def test_picking_is_indexing(shape):
    values, index = torch.randn(shape), torch.tensor([4, 0, 0, 2])
    assert torch.equal(pick(values, index), values[..., index])
