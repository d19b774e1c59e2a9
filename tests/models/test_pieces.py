"""Which pieces of a canonical shape belong to the subject."""

from __future__ import annotations

import pytest
import torch

from snarfcli.models.pieces import floating_cells

# Samples along z, y, x: four cells of two steps along x. The body fills the first, other pieces the third and the last.
BODY, GLASSES, FLOATER = (slice(0, 3), slice(0, 3), slice(0, 2)), (0, slice(0, 2), 4), (1, 1, 7)
FINER = [2, 2, 2]
NOWHERE = (torch.empty(0, 3), torch.empty(0, dtype=torch.long))


@pytest.fixture
def occupied() -> torch.Tensor:
    samples = torch.zeros(3, 3, 9, dtype=torch.bool)
    for piece in (BODY, GLASSES, FLOATER):
        samples[piece] = True
    return samples


def places(*rows: tuple[tuple[float, float, float], int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return places along x, y, z and the point that each belongs to."""
    return torch.tensor([place for place, _ in rows]), torch.tensor([query for _, query in rows])


def test_pieces_that_are_needed_belong_to_the_subject(occupied):
    # Points 1 and 2 lie in the glasses and nowhere else; points 0 and 3 in the body, and at the same time in the floater.
    inside = places(((0.5, 1, 1), 0), ((7.0, 1, 1), 0), ((4.2, 0, 0), 1), ((4.0, 1, 0), 2), ((7.1, 1, 1), 3), ((1.0, 2, 2), 3))
    cells, dropped = floating_cells(occupied, FINER, *inside)
    assert dropped == 1
    assert cells.flatten().tolist() == [False, False, False, True]


def test_without_any_point_only_the_largest_piece_is_left(occupied):
    cells, dropped = floating_cells(occupied, FINER, *NOWHERE)
    assert dropped == 2
    assert cells.flatten().tolist() == [False, True, True, True]


@pytest.mark.parametrize(
    ("components", "wanted"), [(1, [False, True, True, True]), (2, [False, False, False, True]), (9, [False] * 4)]
)
def test_a_given_number_of_largest_pieces_is_kept(occupied, components, wanted):
    cells, dropped = floating_cells(occupied, FINER, *NOWHERE, components)
    assert dropped == max(0, 3 - components)
    assert cells.flatten().tolist() == wanted


def test_a_cell_with_a_part_of_the_body_is_kept():
    samples = torch.zeros(3, 3, 5, dtype=torch.bool)
    samples[0, :, 0] = True
    samples[2, 2, 2] = True  # in both cells; the body is in the first too
    cells, dropped = floating_cells(samples, FINER, *NOWHERE)
    assert dropped == 1
    assert cells.flatten().tolist() == [False, True]


def test_an_empty_shape_has_no_pieces():
    cells, dropped = floating_cells(
        torch.zeros(3, 3, 3, dtype=torch.bool), FINER, torch.empty(0, 3), torch.empty(0, dtype=torch.long)
    )
    assert dropped == 0
    assert not cells.any()
