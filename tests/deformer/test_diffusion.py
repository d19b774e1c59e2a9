"""Given vertex weights in the grid: exact near the vertices as far as the grid allows, and well-behaved elsewhere."""

from __future__ import annotations

import math
import sys

import pytest
import torch
from skinning_scenes import unit_grid

from snarfcli.deformer import PresetWeights, diffusion
from snarfcli.deformer.diffusion import diffuse_weights
from snarfcli.deformer.trilinear import interpolate


def tube(count: int = 4000):
    """Return points [V, 3] on a tube along x, and smooth weights of three bones along it."""
    generator = torch.Generator().manual_seed(0)
    along, around = torch.rand(2, count, generator=generator, dtype=torch.float64)
    x = 1.4 * along - 0.7
    turn = 2 * math.pi * around
    points = torch.stack([x, 0.3 * turn.cos(), 0.3 * turn.sin()], 1)
    scores = torch.stack([-((x - centre) ** 2) / 0.1 for centre in (-0.6, 0.0, 0.6)], 1)
    return points, scores.softmax(1)


def test_near_the_vertices_they_are_exact_as_far_as_the_grid_allows():
    points, weights = tube(20_000)
    errors = []
    for nodes in (9, 17, 33):
        shape = (nodes, nodes, nodes)
        values = diffuse_weights(points[::2], weights[::2], unit_grid(), shape)
        errors.append(float((interpolate(values, points[1::2], unit_grid()) - weights[1::2]).abs().max()))
    assert errors[0] < 0.1
    assert errors[2] < 0.02
    assert errors[0] > 2 * errors[1] > 2 * errors[2]


def test_everywhere_they_are_weights():
    points, weights = tube(500)
    weights[:, 1], weights[:, 2] = 0.0, weights[:, 2] + weights[:, 1]
    values = diffuse_weights(points, weights, unit_grid(), (12, 13, 14))
    assert values.shape == (12, 13, 14, 3)
    assert bool((values >= 0).all())
    assert float(values[..., 1].max()) == 0
    torch.testing.assert_close(values.sum(-1), torch.ones(12, 13, 14, dtype=torch.float64))


def test_between_and_beyond_they_are_means_of_their_neighbours():
    points, weights = tube(500)
    values = diffuse_weights(points, weights, unit_grid(), (16, 16, 16))
    middle = values[1:-1, 1:-1, 1:-1]
    around = [values[2:, 1:-1, 1:-1], values[:-2, 1:-1, 1:-1], values[1:-1, 2:, 1:-1], values[1:-1, :-2, 1:-1]]
    around += [values[1:-1, 1:-1, 2:], values[1:-1, 1:-1, :-2]]
    free = (sum(around) / 6 - middle).abs().amax(-1) < 2e-4  # cubic cells; what solving leaves
    nodes = unit_grid().nodes((16, 16, 16))[1:-1, 1:-1, 1:-1]
    far = (nodes[..., 1:].norm(dim=-1) - 0.3).abs() > 0.25
    assert bool(free[far].all())
    assert int(far.sum()) > 1000
    assert float(values.max()) <= float(weights.max()) + 2e-2  # no new extremes


def test_equal_weights_stay_equal():
    points, _ = tube(50)
    weights = torch.tensor([[0.2, 0.8]], dtype=torch.float64).expand(50, -1)
    values = diffuse_weights(points, weights, unit_grid(), (3, 25, 40))
    torch.testing.assert_close(values, weights[0].expand(3, 25, 40, 2))


def test_one_vertex_fills_the_grid():
    values = diffuse_weights(torch.zeros(1, 3), torch.tensor([[0.0, 1.0]]), unit_grid(torch.float32), (2, 2, 2))
    torch.testing.assert_close(values[..., 1], torch.ones(2, 2, 2))


@pytest.mark.parametrize("shape", [(2, 2, 2), (5, 9, 33), (4, 40, 7)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_size_of_grid(shape, dtype):
    points, weights = tube(1000)
    values = diffuse_weights(points, weights, unit_grid(dtype), shape)
    assert values.shape == (*shape, 3)
    assert values.dtype == dtype
    assert bool((values >= 0).all())
    torch.testing.assert_close(values.sum(-1), torch.ones(shape, dtype=dtype))


@pytest.mark.parametrize("count", [3, 800])
def test_nearest_vertices_are_those_of_all(count):
    """Block by block of nodes, with far fewer distances than all pairs have."""
    shape, (points, _) = (9, 20, 12), tube(count)
    nodes = unit_grid().nodes(shape).reshape(-1, 3)
    some = torch.arange(0, len(nodes), 7)
    distances = torch.cdist(nodes[some], points).topk(min(8, count), largest=False).values
    met = torch.zeros(len(some), dtype=torch.long)
    for block in diffusion._blocks(some, shape):
        squared, index = diffusion._nearest(nodes[some[block]], points)
        met[block] += 1
        torch.testing.assert_close(squared.sqrt(), distances[block])
        torch.testing.assert_close((nodes[some[block], None] - points[index]).norm(dim=-1), distances[block])
    assert bool((met == 1).all())


def test_progress_is_told():
    points, weights = tube(100)
    shares = []
    PresetWeights.from_vertices(points, weights, unit_grid(), (4, 5, 6), shares.append)
    assert shares == [1.0]


def test_long_work_shows_a_bar_on_a_terminal(monkeypatch, capsys):
    pytest.importorskip("tqdm")
    points, weights = tube(100)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    diffuse_weights(points, weights, unit_grid(), (4, 5, 6))
    assert not capsys.readouterr().err
    monkeypatch.setattr(diffusion, "_LONG", 1)
    diffuse_weights(points, weights, unit_grid(), (4, 5, 6))
    assert "diffuse weights: 100%" in capsys.readouterr().err


def test_preset_weights_are_kept_in_the_state_and_not_trained():
    points, weights = tube(300)
    field = PresetWeights.from_vertices(points, weights, unit_grid(), (8, 8, 8))
    assert not list(field.parameters())
    other = PresetWeights.placeholder(unit_grid(), (8, 8, 8), 3)
    torch.testing.assert_close(other(points), torch.full((300, 3), 1 / 3, dtype=torch.float64))
    other.load_state_dict(field.state_dict())
    assert torch.equal(other(points), field(points))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, w: (v[:, :2], w), r"vertices: wanted shape \[V, 3\]"),
        (lambda v, w: (v[:0], w[:0]), "at least one"),
        (lambda v, w: (v, w[1:]), r"weights: wanted shape \[50, J\]"),
        (lambda v, w: (v * torch.nan, w), "vertices: wanted finite"),
        (lambda v, w: (v, w / 0), "weights: wanted finite"),
        (lambda v, w: (v, 2 * w - 1 / 3), "weights: wanted 0 or more"),
        (lambda v, w: (v, 0.9 * w), "weights: wanted a sum of 1 per vertex, got sums from 0.9 to 0.9"),
        (lambda v, w: (v + 1, w), "vertices: wanted all in the canonical box .* of 50 outside"),
    ],
)
def test_what_cannot_be_used_is_rejected(change, message):
    vertices, weights = change(*tube(50))
    with pytest.raises(ValueError, match=message):
        diffuse_weights(vertices, weights, unit_grid(), (4, 4, 4))
