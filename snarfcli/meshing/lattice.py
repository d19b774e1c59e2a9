"""Regular lattices and boolean arithmetic on their nodes and cells; along each axis there is one cell fewer than nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

__all__ = ["Lattice", "any_corner", "first_lattice", "grow", "mixed_cells", "nodes_of_cells"]


@dataclass(frozen=True)
class Lattice:
    """Nodes at `origin + spacing * stride * index`.

    All levels use the spacing of the final lattice, so that a node has exactly the same position on each level.
    """

    origin: np.ndarray
    """[3], position of the first node, metres."""
    spacing: float
    """Cell size of the final lattice, metres."""
    stride: int
    """Cell size of this lattice in cells of the final one; a power of two."""
    shape: tuple[int, ...]
    """Number of nodes along each axis."""

    def split(self) -> Lattice:
        """Return the lattice with half the cell size."""
        return Lattice(self.origin, self.spacing, self.stride // 2, tuple(2 * n - 1 for n in self.shape))

    def positions(self, flat: np.ndarray) -> np.ndarray:
        """Return the positions [N, 3] float32, metres, of nodes with flat indices [N]."""
        index = np.stack(np.unravel_index(flat, self.shape), axis=1) * self.stride
        return (self.origin + index * self.spacing).astype(np.float32)


def first_lattice(lower: Tensor | np.ndarray, upper: Tensor | np.ndarray, resolution: int, coarse: int) -> Lattice:
    """Return the coarsest lattice: centred on a box, with a margin of one cell.

    Args:
        lower: [3], lower corner of the box, metres.
        upper: [3], upper corner of the box, metres.
        resolution: number of cells of the final lattice along the longest side.
        coarse: minimum number of cells of the coarsest lattice along the longest side.

    Raises:
        ValueError: a corner is not finite, the box is empty, or a number is too small.
    """
    corners = [np.asarray(torch.as_tensor(corner).detach().cpu(), dtype=np.float64) for corner in (lower, upper)]
    for name, corner in zip(("lower", "upper"), corners, strict=True):
        if corner.shape != (3,) or not np.isfinite(corner).all():
            raise ValueError(f"{name}: wanted three finite numbers, got {corner.tolist()}")
    size = corners[1] - corners[0]
    if not (size > 0).all():
        raise ValueError(f"upper: wanted more than lower {corners[0].tolist()} on each axis, got {corners[1].tolist()}")
    if resolution < 4:
        raise ValueError(f"resolution: wanted at least 4 cells, got {resolution}")
    if coarse < 1:
        raise ValueError(f"coarse: wanted at least 1 cell, got {coarse}")
    stride = 1
    while resolution >= 2 * stride * coarse:
        stride *= 2
    spacing = size.max() / resolution
    # The small number prevents rounding from adding a layer of cells to a box that is a multiple of a cell.
    cells = np.ceil(size / (spacing * stride) - 1e-6).astype(int) + 2
    origin = (corners[0] + corners[1] - cells * spacing * stride) / 2
    return Lattice(origin=origin, spacing=spacing, stride=stride, shape=tuple(int(n) + 1 for n in cells))


def _pair(nodes: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return views of all entries but the last along an axis, and of all but the first."""
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
    """Return the nodes at the corners of true cells."""
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
    """Set the neighbours of true cells across faces, edges and corners, in place, `steps` times."""
    for _ in range(steps):
        for axis in range(3):
            first, second = _pair(cells, axis)
            before = first.copy()  # without it a true cell would spread along the whole axis
            first |= second
            second |= before
