"""Boolean arithmetic on the nodes and cells of a regular lattice; node arrays have one more entry per axis than cell arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Lattice", "any_corner", "grow", "mixed_cells", "nodes_of_cells"]


@dataclass(frozen=True)
class Lattice:
    """Nodes at `origin + spacing * stride * index`.

    The spacing is the one of the final lattice on every level, so that a node has the same position on all of them, to the bit.
    """

    origin: np.ndarray
    spacing: float
    stride: int
    shape: tuple[int, ...]

    def split(self) -> Lattice:
        """Return the lattice with half the cell size."""
        return Lattice(self.origin, self.spacing, self.stride // 2, tuple(2 * n - 1 for n in self.shape))

    def positions(self, flat: np.ndarray) -> np.ndarray:
        """Return the positions of nodes, [N, 3] float32, given by their flat index [N]."""
        index = np.stack(np.unravel_index(flat, self.shape), axis=1) * self.stride
        return (self.origin + index * self.spacing).astype(np.float32)


def _pair(nodes: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    rest = (slice(None),) * axis
    return nodes[(*rest, slice(None, -1))], nodes[(*rest, slice(1, None))]


def any_corner(nodes: np.ndarray) -> np.ndarray:
    """Return the cells with at least one true corner."""
    for axis in range(3):
        first, second = _pair(nodes, axis)
        nodes = first | second
    return nodes


def mixed_cells(nodes: np.ndarray) -> np.ndarray:
    """Return the cells with true and false corners."""
    every = nodes
    for axis in range(3):
        first, second = _pair(every, axis)
        every = first & second
    cells = any_corner(nodes)
    cells &= ~every
    return cells


def nodes_of_cells(cells: np.ndarray) -> np.ndarray:
    """Return the corners of true cells."""
    for axis in range(3):
        shape = list(cells.shape)
        shape[axis] += 1
        nodes = np.zeros(shape, dtype=bool)
        first, second = _pair(nodes, axis)
        first |= cells
        second |= cells
        cells = nodes
    return cells


def grow(cells: np.ndarray, steps: int) -> None:
    """Set the neighbours of true cells, across faces, edges and corners, in place."""
    for _ in range(steps):
        for axis in range(3):
            first, second = _pair(cells, axis)
            before = first.copy()  # without it a true cell would spread along the whole axis
            first |= second
            second |= before
