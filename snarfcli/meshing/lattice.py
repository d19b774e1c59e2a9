"""Regular lattices, and boolean arithmetic on their nodes and cells, on any device.

A cell has the index of its lowest node, so that arrays of nodes and of cells have the same shape [X, Y, Z]. In the last layers,
where no cell begins, arrays of cells are false. Arrays are shifted as flat ones: along the last axis this takes a fifth of the
time. A row then continues in the next one, which matters only where no cell begins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["Lattice", "double", "first_lattice", "flat_indices", "grow", "list_mixed_cells", "mixed_cells", "nodes_of_cells"]

# Nodes looked at together. On a CPU a slab stays in the cache; on a GPU it bounds the memory at 1024 voxels.
_SLAB = 2**19
_SLAB_ON_GPU = 2**27


@dataclass(frozen=True)
class Lattice:
    """Nodes at `origin + spacing * stride * index`.

    All levels use the spacing of the final lattice, so that a node has exactly the same position on each level.
    """

    origin: tuple[float, ...]
    """Position of the first node, metres."""
    spacing: float
    """Cell size of the final lattice, metres."""
    stride: int
    """Cell size of this lattice in cells of the final one; a power of two."""
    shape: tuple[int, ...]
    """Number of nodes along each axis."""

    @property
    def size(self) -> int:
        """Number of nodes."""
        return math.prod(self.shape)

    @property
    def steps(self) -> tuple[int, int, int]:
        """Differences between the flat indices of neighbours along each axis."""
        return _steps(self.shape)

    @property
    def final(self) -> Lattice:
        """The lattice with the cell size of the final one."""
        return Lattice(self.origin, self.spacing, 1, tuple(self.stride * (n - 1) + 1 for n in self.shape))

    def split(self) -> Lattice:
        """Return the lattice with half the cell size."""
        return Lattice(self.origin, self.spacing, self.stride // 2, tuple(2 * n - 1 for n in self.shape))

    def places(self, flat: Tensor) -> Tensor:
        """Return the places [N, 3], int64, of nodes with flat indices [N]."""
        rows = flat // self.shape[2]
        return torch.stack([rows // self.shape[1], rows % self.shape[1], flat % self.shape[2]], dim=1)

    def flat(self, places: Tensor) -> Tensor:
        """Return the flat indices [...] of places [..., 3]; those outside the lattice are moved to its border."""
        x, y, z = (places[..., axis].clamp(0, nodes - 1) for axis, nodes in enumerate(self.shape))
        return (x * self.shape[1] + y) * self.shape[2] + z

    def positions(self, places: Tensor) -> Tensor:
        """Return the positions [N, 3] float32, metres, of places [N, 3], which need not be nodes."""
        scaled = (places * self.stride).double() * self.spacing
        return torch.stack([scaled[:, axis] + start for axis, start in enumerate(self.origin)], dim=1).float()


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
    spacing = float(size.max() / resolution)
    # The small number prevents rounding from adding a layer of cells to a box that is a multiple of a cell.
    cells = np.ceil(size / (spacing * stride) - 1e-6).astype(int) + 2
    origin = (corners[0] + corners[1] - cells * spacing * stride) / 2
    return Lattice(tuple(origin.tolist()), spacing, stride, tuple(int(n) + 1 for n in cells))


def flat_indices(flags: Tensor) -> Tensor:
    """Return the flat indices of true entries, ascending, [N] int64; on a GPU this waits for their number."""
    if flags.device.type == "cpu":  # NumPy takes a third of the time
        return torch.from_numpy(np.flatnonzero(flags.numpy()))
    return flags.reshape(-1).nonzero()[:, 0]


def mixed_cells(nodes: Tensor) -> Tensor:
    """Return the cells with true and false corners; no node at the border may be true."""
    cells = _mixed(nodes)
    return F.pad(cells, (0, nodes.numel() - len(cells))).view(nodes.shape)


def list_mixed_cells(nodes: Tensor, known: Tensor | None = None) -> Tensor:
    """Return the flat indices of `mixed_cells`, ascending, [C] int64; on a GPU this waits for their number.

    Args:
        nodes: [X, Y, Z], bool; none at the border may be true.
        known: [X, Y, Z], bool; if given, only cells with a corner that is not known are listed.
    """
    step = _steps(nodes.shape)[0]
    layers = max(1, (_SLAB if nodes.device.type == "cpu" else _SLAB_ON_GPU) // step)
    lists = []
    for begin in range(0, nodes.shape[0] - 1, layers):
        slab = slice(begin, begin + layers + 1)
        cells = _mixed(nodes[slab])
        if known is not None:
            cells = cells > _all_corners(known[slab])
        lists.append(flat_indices(cells) + begin * step)
    return torch.cat(lists)


def nodes_of_cells(cells: Tensor) -> Tensor:
    """Return the nodes at the corners of true cells."""
    nodes = cells.reshape(-1)
    for step in _steps(cells.shape):
        nodes = _with_shifted(nodes, step)
    return nodes.view(cells.shape)


def grow(cells: Tensor, layers: int) -> Tensor:
    """Return the true cells and their neighbours across faces, edges and corners, `layers` cells thick."""
    for _ in range(layers):
        flat = cells.reshape(-1)
        for step in reversed(_steps(cells.shape)):
            wider = _with_shifted(flat, step)
            wider[:-step] |= flat[step:]
            flat = wider
        cells = flat.view(cells.shape)
        for axis in range(3):
            cells.select(axis, -1).fill_(False)  # rows have run into each other there
    return cells


def double(flags: Tensor) -> Tensor:
    """Return flags of the lattice with half the cell size: a new node or cell takes the one below or at its place."""
    x, y, z = flags.shape
    # two equal bytes at once
    rows = (flags.contiguous().view(torch.uint8).to(torch.int16) * 257).view(torch.uint8)[:, :, : 2 * z - 1].view(torch.bool)
    fine = flags.new_empty(2 * x - 1, 2 * y - 1, 2 * z - 1)
    fine[::2, ::2] = rows
    fine[::2, 1::2] = rows[:, :-1]
    fine[1::2] = fine[:-1:2]
    return fine


def _steps(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return the differences between the flat indices of neighbours along each axis."""
    return shape[1] * shape[2], shape[2], 1


def _with_shifted(flat: Tensor, step: int) -> Tensor:
    """Return whether an entry or the one `step` before it is true."""
    both = flat.clone()
    both[step:] |= flat[:-step]
    return both


def _mixed(nodes: Tensor) -> Tensor:
    """Return `mixed_cells` as a flat array that ends with the last cell.

    Rows run into each other where no cell begins, but the corners that are put together there are all at the border.
    """
    some = nodes.reshape(-1)
    for step in _steps(nodes.shape):
        some = some[:-step] | some[step:]
    return some > _all_corners(nodes)


def _all_corners(nodes: Tensor) -> Tensor:
    """Return whether all corners of each cell are true, as a flat array that ends with the last cell."""
    every = nodes.reshape(-1)
    for step in _steps(nodes.shape):
        every = every[:-step] & every[step:]
    return every
