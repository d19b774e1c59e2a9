"""Coarse-to-fine evaluation of a field on lattices, on any device.

For each node of the current lattice it is stored whether it is inside, and whether it was evaluated. Values are stored in the
final lattice, at the nodes that were evaluated. The host waits for the device for the length of each list of nodes to evaluate,
and twice on each level to learn that nothing is left to evaluate.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.meshing.evaluator import Evaluator
from snarfcli.meshing.lattice import Lattice, double, flat_indices, grow, list_mixed_cells, mixed_cells, nodes_of_cells

__all__ = ["Descent", "descend", "evaluate_nodes", "occupied_sides"]

# Layers of cells around an unfinished one that are evaluated as well. With two, a body at 256 voxels takes 9 calls of the field
# instead of 12 with one, and 2 % more points.
_LAYERS = 2
_CELLS = 16384  # cells whose surroundings are listed at once, to bound the memory


@dataclass
class Descent:
    """A lattice whose values are partly known."""

    lattice: Lattice
    inside: Tensor
    """[X, Y, Z], bool: whether the value is above zero; an unknown node takes this from a neighbour on a coarser lattice. False
    at the border, even if the value is above zero there."""
    known: Tensor
    """[X, Y, Z], bool: whether the value was evaluated."""
    values: Tensor
    """[N] float32, field minus level at the N nodes of the final lattice; anything where it was not evaluated."""

    @classmethod
    def begin(cls, lattice: Lattice, values: Tensor) -> Descent:
        """Return a lattice whose values [X, Y, Z] are all known."""
        inside = _close_border(values > 0)
        final = values.new_empty(lattice.final.shape)
        final[:: lattice.stride, :: lattice.stride, :: lattice.stride] = values
        return cls(lattice, inside, torch.ones_like(inside), final.view(-1))

    def evaluate(self, evaluator: Evaluator, wanted: Tensor) -> None:
        """Evaluate the unknown ones among the `wanted` nodes, [X, Y, Z], bool."""
        flat = flat_indices(wanted > self.known)
        if not len(flat):
            return
        values = evaluate_nodes(evaluator, self.lattice, flat)
        self.values[self.lattice.final.flat(self.lattice.stride * self.lattice.places(flat))] = values
        self.inside.view(-1)[flat] = values > 0
        _close_border(self.inside)
        self.known |= wanted

    def complete(self, evaluator: Evaluator) -> None:
        """Evaluate the unknown corners of mixed cells, and around them, until all corners of mixed cells are known."""
        reach = torch.arange(-_LAYERS, _LAYERS + 2, device=self.known.device)
        around = torch.cartesian_prod(reach, reach, reach)
        while len(cells := list_mixed_cells(self.inside, self.known)):
            wanted = torch.zeros_like(self.known)
            for part in cells.split(_CELLS):
                nodes = self.lattice.flat(self.lattice.places(part)[:, None] + around)
                wanted.view(-1).index_fill_(0, nodes.view(-1), 1)
            self.evaluate(evaluator, wanted)

    def split(self) -> None:
        """Halve the cells. A new node is inside where a neighbour is, until it is evaluated."""
        self.lattice = self.lattice.split()
        known = self.known.new_zeros(self.lattice.shape)
        known[::2, ::2, ::2] = self.known
        self.inside, self.known = double(self.inside), known

    def occupied_sides(self) -> Tensor:
        """Return the sides of the final lattice on which values above zero were found at the border, bool [3, 2]."""
        return occupied_sides(self.values.view(self.lattice.shape), self.known)


def descend(evaluator: Evaluator, lattice: Lattice, values: Tensor, dilate: int) -> Descent:
    """Refine from the first lattice to the final one.

    Args:
        evaluator: gives the values.
        lattice: the first lattice.
        values: [X, Y, Z], values at all its nodes.
        dilate: width, in cells, of the layer around mixed cells that is split as well, on all levels but the last.
    """
    descent = Descent.begin(lattice, values)
    while descent.lattice.stride > 1:
        cells = mixed_cells(descent.inside)
        if descent.lattice.stride > 2:
            cells = grow(cells, dilate)
        descent.split()
        descent.evaluate(evaluator, nodes_of_cells(double(cells)))
        descent.complete(evaluator)
    return descent


def evaluate_nodes(evaluator: Evaluator, lattice: Lattice, flat: Tensor) -> Tensor:
    """Return field minus level, [N], at nodes with flat indices [N]."""
    parts = flat.split(evaluator.chunk)  # also bounds the memory of the positions
    return torch.cat([evaluator.at(lattice.positions(lattice.places(part))) for part in parts])


def occupied_sides(values: Tensor, known: Tensor | None = None) -> Tensor:
    """Return which sides of a lattice have known values above zero at the border, bool [3, 2].

    Args:
        values: [X, Y, Z].
        known: [X, Y, Z], bool; None if all are known.
    """
    sides = []
    for axis in range(3):
        for end in (0, -1):
            occupied = values.select(axis, end) > 0
            sides.append((occupied if known is None else occupied & known.select(axis, end)).any())
    return torch.stack(sides).view(3, 2)


def _close_border(inside: Tensor) -> Tensor:
    """Make the outermost nodes of [X, Y, Z] false, in place, and return all."""
    for axis in range(3):
        for end in (0, -1):
            inside.select(axis, end).fill_(False)
    return inside
