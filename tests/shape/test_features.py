"""Feature grids: which nodes have features, how the grids grow, and how they are loaded."""

from __future__ import annotations

import pytest
import torch

from snarfcli.networks import run_encoding
from snarfcli.shape.features import FeatureGrids

LOWER, UPPER = torch.tensor([-1.0, -1.0, -0.4]), torch.tensor([1.0, 1.2, 0.4])


def grids(cells=(0.4, 0.1), features: int = 2) -> FeatureGrids:
    return FeatureGrids(LOWER, UPPER, cells, features)


def block(*corners: tuple[int, int, int]) -> torch.Tensor:
    """Return which of [4, 11, 10] cells of 20 cm are named, by (z, y, x)."""
    cells = torch.zeros(4, 11, 10, dtype=torch.bool)
    for corner in corners:
        cells[corner] = True
    return cells


def features_at(made: FeatureGrids, points: torch.Tensor) -> torch.Tensor:
    return run_encoding(points, torch.empty(0), *made.arrays)[:, 3:]


def test_levels_fill_the_box():
    made = grids()
    assert made.nodes == [6, 7, 3, 21, 23, 9]  # W, H, D
    assert made.size == 4
    lower, size = torch.tensor(made.boxes).view(2, 2, 3).unbind(1)
    torch.testing.assert_close(lower, LOWER.expand(2, 3))
    counts = torch.tensor(made.nodes).view(2, 3) - 1
    torch.testing.assert_close(lower + size * counts, UPPER.expand(2, 3))


def test_points_in_covered_cells_have_all_corners():
    made = grids()
    cells = block((1, 3, 4), (3, 10, 9))
    assert made.cover(cells) == len(made.table) > 0
    assert made.cover(cells) == 0
    with torch.no_grad():
        made.table.fill_(1.0)
    generator = torch.Generator().manual_seed(0)
    for corner in cells.nonzero():
        inside = (corner.flip(0) + torch.rand(50, 3, generator=generator)) * 0.2 + LOWER
        torch.testing.assert_close(features_at(made, inside), torch.ones(50, 4), rtol=0, atol=1e-6)
    far = torch.tensor([[-0.9, 1.0, -0.3]])
    assert not features_at(made, far).any()


def test_covering_everything():
    made = grids()
    assert made.cover() == made.num_nodes == 6 * 7 * 3 + 21 * 23 * 9
    assert sorted(made.rows.tolist()) == list(range(made.num_nodes))


def test_growth_keeps_what_is_there():
    made = grids()
    first = made.cover(block((1, 3, 4)))
    before, rows = made.table.detach().clone(), made.rows.clone()
    more = made.cover(block((1, 3, 4), (1, 3, 5)))
    assert more > 0
    assert len(made.table) == first + more
    assert torch.equal(made.table[:first], before)
    assert torch.equal(made.rows[rows >= 0], rows[rows >= 0])


def test_a_grown_state_is_loaded():
    made, other = grids(), grids()
    made.cover(block((1, 3, 4), (2, 2, 2)))
    other.cover(block((0, 0, 0)))
    other.load_state_dict(made.state_dict())
    points = torch.rand(100, 3) * (UPPER - LOWER) + LOWER
    assert torch.equal(features_at(made, points), features_at(other, points))


def test_rows_beyond_the_table_are_rejected():
    made = grids()
    made.cover(block((1, 3, 4)))
    state = made.state_dict()
    state["rows"] = state["rows"] + 1000
    with pytest.raises(RuntimeError, match="rows"):
        grids().load_state_dict(state)


@pytest.mark.parametrize(
    ("cells", "features", "message"),
    [
        ([3.0], 4, r"shape.feature_cells_m: wanted cells of more than 0 and at most 2.2 m"),
        ([0.0], 4, r"wanted cells of more than 0"),
        ([0.1], 0, r"shape.features: wanted 1 to 16, got 0"),
        ([0.1], 17, r"shape.features: wanted 1 to 16, got 17"),
        (
            [0.1, 0.002],
            4,
            r"the grids would have 4\d\d million nodes; wanted at most 34 million; give cells of 0.\d+ m",
        ),
    ],
)
def test_settings_that_make_no_grid(cells, features, message):
    with pytest.raises(ValueError, match=message):
        grids(cells, features)
