"""Watertight surfaces of fields: coarse-to-fine evaluation and marching cubes.

The field is evaluated on a coarse lattice first. Cells whose corners differ in sign, and their neighbours, are split in two
along each axis and evaluated again, down to the requested resolution (MISE: Mescheder et al., Occupancy Networks, CVPR 2019,
section 3.3). Then the unknown corners of cells with mixed signs are evaluated, and so on outwards, until no surface ends at
the edge of the evaluated region. Except for features that the coarse lattice misses, the mesh equals that of the full lattice.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from snarfcli.errors import UserError
from snarfcli.meshing.lattice import Lattice, any_corner, first_lattice, grow, mixed_cells, nodes_of_cells
from snarfcli.meshing.marching import MARGIN, Crossings, march
from snarfcli.meshing.mesh import ExtractionStats, Mesh, keep_components

__all__ = ["EmptySurface", "FullSurface", "extract_surface"]

# Minimum and maximum number of cells of the first lattice along the longest side, by default a quarter of the resolution. 64
# are 3 cm on a standing body. Thin parts that join a part found by the first lattice are followed, so this matters only for
# loose parts.
_COARSE = (32, 64)
# Width, in cells, of the layer around mixed cells that is split as well, on all levels but the last.
_DILATE = 1
# Maximum number of times that a box is widened, each time by a sixteenth of its longest side.
_WIDENINGS = 8
# Node layers processed at once: bounds the memory, does not change the result.
_SLAB = 32


class EmptySurface(ValueError):
    """The field has no surface: it is unoccupied everywhere in the box."""


class FullSurface(ValueError):
    """The field has no surface: it is occupied everywhere in the box."""


def extract_surface(
    field: Callable[[Tensor], Tensor],
    lower: Tensor | np.ndarray,
    upper: Tensor | np.ndarray,
    resolution: int,
    *,
    level: float = 0.0,
    coarse: int | None = None,
    dilate: int = _DILATE,
    widen: bool = False,
    refine: int = 1,
    keep_share: float = 0.01,
    chunk: int = 65536,
) -> Mesh:
    """Extract the surface where `field` crosses `level` in a box, as a closed mesh of outward triangles.

    Args:
        field: points [N, 3] float32 on the CPU -> values [N] on any device; occupied where above `level`. Infinite
            values are allowed. The value at a point must not depend on the other points of the call.
        lower: [3], lower corner of the box, metres.
        upper: [3], upper corner of the box, metres.
        resolution: number of cells along the longest side of the box; cells are cubes.
        level: value at the surface.
        coarse: minimum number of cells of the first lattice along the longest side; loose parts smaller than such a cell can be
            missed. None: a quarter of `resolution`, at least 32 and at most 64.
        dilate: width, in cells, of the layer around the surface that is split as well, on all levels but the last.
        widen: whether a box that is only an estimate grows: a side with an occupied border moves outwards until the border is
            unoccupied, or the box is two and a half times as large.
        refine: number of evaluations per vertex that move it along its lattice edge to the crossing of `level`. With 0, a field
            that is not linear in a cell shows terraces.
        keep_share: a connected surface with fewer faces than this share of the largest one is dropped.
        chunk: maximum number of points per call of the field.

    Returns:
        The mesh in the frame of the box, with `stats`. A surface that leaves the box is closed at its border.

    Raises:
        EmptySurface: no evaluated point is occupied.
        FullSurface: all evaluated points are occupied.
        ValueError: an argument is out of range, or the field returns a wrong shape.
        UserError: the field returns NaN.
    """
    start = time.perf_counter()
    if coarse is None:
        coarse = min(max(resolution // 4, _COARSE[0]), _COARSE[1])
    lattice = first_lattice(lower, upper, resolution, coarse)
    for name, value, least in (("chunk", chunk, 1), ("dilate", dilate, 0), ("refine", refine, 0)):
        if value < least:
            raise ValueError(f"{name}: wanted at least {least}, got {value}")
    if not 0.0 <= keep_share <= 1.0:
        raise ValueError(f"keep_share: wanted a share between 0 and 1, got {keep_share}")
    evaluator = _Evaluator(field, level, chunk)

    values = np.empty(lattice.shape, dtype=np.float32)
    evaluator.fill(lattice, values, np.ones(lattice.shape, dtype=bool))
    inside = values > 0
    if not inside.any():
        raise EmptySurface(f"the field is unoccupied at all {inside.size} points of the first lattice, so there is no surface")
    if inside.all():
        raise FullSurface(
            f"the field is occupied at all {inside.size} points of the first lattice, so it has no surface in the box"
        )
    for widening in range(_WIDENINGS + 1):
        last = widening == _WIDENINGS or not widen
        sides = _occupied_sides(values)
        if last or not sides.any():
            final, final_values, sides = _descend(evaluator, lattice, values.copy(), dilate)
        if last or not sides.any():
            break
        lattice, values = _widen(evaluator, lattice, values, sides)

    crossings = march(final_values)
    vertices = _place(evaluator, final, crossings, refine)
    faces = crossings.faces
    vertices, faces, found, kept = keep_components(vertices, faces, keep_share)
    stats = ExtractionStats(
        points=evaluator.points,
        calls=evaluator.calls,
        voxel=float(final.spacing),
        components=found,
        kept=kept,
        capped=bool(sides.any()),
        seconds=time.perf_counter() - start,
    )
    return Mesh(vertices, faces, stats=stats)


def _widen(evaluator: _Evaluator, lattice: Lattice, values: np.ndarray, sides: np.ndarray) -> tuple[Lattice, np.ndarray]:
    """Add cells to the first lattice on some sides, bool [3, 2], and evaluate them."""
    pads = sides * max(1, max(lattice.shape) // (2 * _WIDENINGS))
    wanted = np.pad(np.zeros(lattice.shape, dtype=bool), pads, constant_values=True)
    values = np.pad(values, pads)
    origin = lattice.origin - pads[:, 0] * lattice.spacing * lattice.stride
    lattice = Lattice(origin, lattice.spacing, lattice.stride, wanted.shape)
    evaluator.fill(lattice, values, wanted)
    return lattice, values


def _descend(
    evaluator: _Evaluator, lattice: Lattice, values: np.ndarray, dilate: int
) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """Refine from the first lattice, all of whose values are known, to the last.

    Returns:
        The last lattice, its values, and the sides on which occupied nodes were closed, bool [3, 2].
    """
    known = np.ones(lattice.shape, dtype=bool)
    sides = _close_border(values)
    while lattice.stride > 1:
        sides |= _complete(evaluator, lattice, values, known)
        cells = mixed_cells(values > 0)
        if lattice.stride > 2:
            grow(cells, dilate)
        lattice, values, known = _split(lattice, values, known)
        wanted = nodes_of_cells(cells.repeat(2, 0).repeat(2, 1).repeat(2, 2))
        wanted &= ~known
        evaluator.fill(lattice, values, wanted)
        known |= wanted
        sides |= _close_border(values)
    sides |= _complete(evaluator, lattice, values, known)
    return lattice, values, sides


def _split(lattice: Lattice, values: np.ndarray, known: np.ndarray) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """Halve the cells. New nodes take the value of a neighbour until they are evaluated, which keeps their signs correct."""
    finer = lattice.split()
    fine_values = np.empty(finer.shape, dtype=np.float32)
    rows = values.repeat(2, axis=2)[:, :, :-1]
    fine_values[::2, ::2] = rows
    fine_values[::2, 1::2] = rows[:, :-1]
    fine_values[1::2] = fine_values[:-1:2]
    fine_known = np.zeros(finer.shape, dtype=bool)
    fine_known[::2, ::2, ::2] = known
    return finer, fine_values, fine_known


def _complete(evaluator: _Evaluator, lattice: Lattice, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Evaluate the unknown corners of mixed cells, and around them, until all corners of mixed cells are known.

    Returns:
        The sides on which occupied nodes were closed, bool [3, 2].
    """
    sides = np.zeros((3, 2), dtype=bool)
    while True:
        cells = _unfinished(values, known)
        if cells is None:
            return sides
        grow(cells, 1)
        wanted = nodes_of_cells(cells)
        wanted &= ~known
        evaluator.fill(lattice, values, wanted)
        known |= wanted
        sides |= _close_border(values)


def _unfinished(values: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """Return the mixed cells that have an unknown corner, or None if there are none; computed in slabs to save memory."""
    cells = None
    for begin in range(0, values.shape[0] - 1, _SLAB):
        part = slice(begin, begin + _SLAB + 1)
        if known[part].all():
            continue
        slab = mixed_cells(values[part] > 0)
        slab &= any_corner(~known[part])
        if slab.any():
            if cells is None:
                cells = np.zeros([n - 1 for n in values.shape], dtype=bool)
            cells[begin : begin + _SLAB] = slab
    return cells


def _faces(values: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield the six outermost layers of nodes: axis, end (0 or 1) and a view."""
    for axis in range(3):
        for end in (0, 1):
            yield axis, end, values[(slice(None),) * axis + (-end,)]


def _occupied_sides(values: np.ndarray) -> np.ndarray:
    """Return which sides have occupied border nodes, bool [3, 2]."""
    sides = np.zeros((3, 2), dtype=bool)
    for axis, end, face in _faces(values):
        sides[axis, end] = (face > 0).any()
    return sides


def _close_border(values: np.ndarray) -> np.ndarray:
    """Make the outermost nodes unoccupied; return the sides on which some were occupied, bool [3, 2]."""
    sides = _occupied_sides(values)
    for _, _, face in _faces(values):
        np.negative(face, out=face, where=face > 0)
    return sides


def _place(evaluator: _Evaluator, lattice: Lattice, crossings: Crossings, refine: int) -> np.ndarray:
    """Return the vertices [V, 3] float32: the zeros of the field on the lattice edges, by false position."""
    low, high = np.zeros(len(crossings.axis)), np.ones(len(crossings.axis))
    value_low, value_high = crossings.value_a.copy(), crossings.value_b.copy()
    for step in range(refine + 1):
        along = low + (high - low) * (value_low / (value_low - value_high))
        nodes = crossings.node_a.astype(np.float64)
        nodes[np.arange(len(nodes)), crossings.axis] += np.clip(along, MARGIN, 1 - MARGIN)
        vertices = (lattice.origin + nodes * lattice.spacing).astype(np.float32)
        if step < refine:
            value = evaluator.at(vertices).astype(np.float64)
            below = (value > 0) == (value_low > 0)  # the zero is further along
            low, value_low = np.where(below, along, low), np.where(below, value, value_low)
            high, value_high = np.where(below, high, along), np.where(below, value_high, value)
    return vertices


class _Evaluator:
    """Evaluates the field at lattice nodes in chunks, and counts points and calls."""

    def __init__(self, field: Callable[[Tensor], Tensor], level: float, chunk: int) -> None:
        self.field = field
        self.level = level
        self.chunk = chunk
        self.points = 0
        self.calls = 0

    def fill(self, lattice: Lattice, values: np.ndarray, wanted: np.ndarray) -> None:
        """Set `values` at the `wanted` nodes to field minus level."""
        flat = np.flatnonzero(wanted)
        out = values.reshape(-1)
        for begin in range(0, len(flat), self.chunk):
            part = flat[begin : begin + self.chunk]
            out[part] = self.at(lattice.positions(part))

    @torch.no_grad()
    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return field minus level, [N] float32 and finite, at positions [N, 3] float32."""
        out = np.empty(len(positions), dtype=np.float32)
        largest = np.finfo(np.float32).max / 4
        for begin in range(0, len(positions), self.chunk):
            part = slice(begin, begin + self.chunk)
            points = torch.from_numpy(positions[part])
            result = self.field(points)
            if result.shape != points.shape[:1]:
                raise ValueError(f"field: wanted shape [{len(points)}], one value per point, got {list(result.shape)}")
            result_np = result.detach().to("cpu", torch.float32).numpy() - np.float32(self.level)
            if np.isnan(result_np).any():
                raise UserError(f"field: wanted numbers, got NaN at {np.isnan(result_np).sum()} of {len(points)} points")
            out[part] = np.clip(result_np, -largest, largest)
            self.points += len(points)
            self.calls += 1
        return out
