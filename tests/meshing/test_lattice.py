from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

from snarfcli.meshing import lattice
from snarfcli.meshing.lattice import Lattice, double, flat_indices, grow, list_mixed_cells, mixed_cells, nodes_of_cells

SHAPE = (9, 6, 7)


def random_flags(share: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(SHAPE) < share


def inner_flags(share: float) -> np.ndarray:
    """Return random flags of nodes, none at the border."""
    flags = random_flags(share)
    flags[[0, -1]] = flags[:, [0, -1]] = flags[:, :, [0, -1]] = False
    return flags


def cells_only(flags: np.ndarray) -> np.ndarray:
    """Return flags without those in the last layers, where no cell begins."""
    flags = flags.copy()
    flags[-1] = flags[:, -1] = flags[:, :, -1] = False
    return flags


def over_corners(extreme, nodes: np.ndarray) -> np.ndarray:
    return cells_only(extreme(nodes, 2, origin=-1))


@pytest.mark.parametrize("slab", [1, 100, 10**6])
def test_mixed_and_unfinished_cells(slab, monkeypatch):
    monkeypatch.setattr(lattice, "_SLAB", slab)
    nodes, known = inner_flags(0.4), random_flags(0.9, 1)
    mixed = over_corners(maximum_filter, nodes) & ~over_corners(minimum_filter, nodes)
    np.testing.assert_array_equal(mixed_cells(torch.from_numpy(nodes)), mixed)
    np.testing.assert_array_equal(list_mixed_cells(torch.from_numpy(nodes)), np.flatnonzero(mixed))
    unfinished = mixed & ~over_corners(minimum_filter, known)
    assert 0 < unfinished.sum() < mixed.sum()
    found = list_mixed_cells(torch.from_numpy(nodes), torch.from_numpy(known))
    np.testing.assert_array_equal(found, np.flatnonzero(unfinished))


def test_nodes_of_cells():
    cells = cells_only(random_flags(0.1))
    np.testing.assert_array_equal(nodes_of_cells(torch.from_numpy(cells)), maximum_filter(cells, 2))


@pytest.mark.parametrize("layers", [0, 1, 2])
def test_cells_grow_by_layers_and_not_into_the_next_row(layers):
    cells = cells_only(random_flags(0.02))
    wanted = binary_dilation(cells, np.ones((3, 3, 3)), iterations=layers) if layers else cells
    np.testing.assert_array_equal(grow(torch.from_numpy(cells), layers), cells_only(wanted))


def test_doubled_flags_are_those_at_or_below():
    flags = random_flags(0.5)
    wanted = flags.repeat(2, 0).repeat(2, 1).repeat(2, 2)[:-1, :-1, :-1]
    np.testing.assert_array_equal(double(torch.from_numpy(flags)), wanted)


def test_places_and_positions():
    coarse = Lattice((0.1, -0.2, 0.3), 0.5, 4, SHAPE)
    flat = torch.arange(coarse.size)
    places = coarse.places(flat)
    np.testing.assert_array_equal(places, np.stack(np.unravel_index(flat.numpy(), SHAPE), 1))
    np.testing.assert_array_equal(coarse.flat(places), flat)
    assert coarse.flat(torch.tensor([[-3, 2, 99]])).item() == 2 * 7 + 6
    np.testing.assert_allclose(coarse.positions(places), np.array(coarse.origin) + 2.0 * places.numpy(), rtol=1e-6)
    final = coarse.split().split()
    assert final == coarse.final
    np.testing.assert_array_equal(final.positions(4 * places), coarse.positions(places))


def test_indices_are_those_of_true_entries():
    flags = random_flags(0.3)
    np.testing.assert_array_equal(flat_indices(torch.from_numpy(flags)), np.flatnonzero(flags))
