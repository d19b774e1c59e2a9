"""Watertight surfaces of fields: coarse-to-fine evaluation and marching cubes.

The field is evaluated on a coarse lattice first. Cells whose corners differ in sign, and their neighbours, are split in two
along each axis and evaluated again, down to the wanted resolution (MISE: Mescheder et al., Occupancy Networks, CVPR 2019,
section 3.3). A cell with mixed signs whose corners are not all known is then completed, and so on outwards, until
no surface ends where the evaluation ended: away from features that the coarse lattice misses altogether, the mesh is
the one of the full lattice.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from snarfcli.meshing.lattice import Lattice, any_corner, grow, mixed_cells, nodes_of_cells
from snarfcli.meshing.marching import MARGIN, Crossings, march
from snarfcli.meshing.mesh import ExtractionStats, Mesh, keep_components

__all__ = ["EmptySurface", "FullSurface", "extract_surface"]

# First lattice, cells along the longest side: a quarter of the resolution, within these bounds. 64 are 3 cm on a standing body.
# What is joined to something that the first lattice meets is followed however thin it is, so this matters for loose parts.
_COARSE = (32, 64)
# Cells around the mixed ones that are split as well, on all levels but the last.
_DILATE = 1
# Steps in which a box that was too small is widened by up to half of its longest side, each way.
_WIDENINGS = 8
# Node layers looked at together: bounds the memory, not the result.
_SLAB = 32


class EmptySurface(ValueError):
    """The field is unoccupied everywhere in the box, so there is no surface."""


class FullSurface(ValueError):
    """The field is occupied everywhere in the box, so there is no surface."""


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
    """Extract the surface where `field` crosses `level` inside a box, as a closed mesh of outward triangles.

    Args:
        field: points [N, 3] float32 on the CPU -> values [N] on any device; occupied where above `level`. Infinite
            values are allowed. Each point must have a value of its own, whatever points come with it.
        lower: [3] corner of the box, metres.
        upper: [3] opposite corner.
        resolution: cells along the longest side of the box; cells are cubes.
        level: value at the surface.
        coarse: cells along the longest side of the first lattice, at least; loose parts smaller than such a cell can be
            missed. By default a quarter of `resolution`, within 32 and 64.
        dilate: cells around the surface that are split as well, on all levels but the last.
        widen: where the field is occupied at the border of the box, move the border outwards until it is not, at most by
            half the box. For boxes that are an estimate.
        refine: evaluations at each vertex that move it along its lattice edge to where the field really crosses `level`.
            Without one, a field that is not linear within a cell shows terraces.
        keep_share: connected surfaces with fewer faces than this share of the largest one's are dropped.
        chunk: points in one call of the field.

    Returns:
        vertices in the frame of the box, with `stats`. A surface that leaves the box is closed at its border.

    Raises:
        EmptySurface: no evaluated point is occupied.
        FullSurface: all evaluated points are occupied.
        ValueError: an argument is out of range, or the field returns NaN or a wrong shape.
    """
    start = time.perf_counter()
    if coarse is None:
        coarse = min(max(resolution // 4, _COARSE[0]), _COARSE[1])
    lattice = _first_lattice(lower, upper, resolution, coarse)
    for name, value, least in (("chunk", chunk, 1), ("dilate", dilate, 0), ("refine", refine, 0)):
        if value < least:
            raise ValueError(f"{name}: wanted at least {least}, got {value}")
    if not 0.0 <= keep_share <= 1.0:
        raise ValueError(f"keep_share: wanted a share between 0 and 1, got {keep_share}")
    evaluator = _Evaluator(field, level, chunk)

    wanted = np.ones(lattice.shape, dtype=bool)
    values = np.empty(lattice.shape, dtype=np.float32)
    evaluator.fill(lattice, values, wanted)
    inside = values > 0
    if not inside.any():
        raise EmptySurface(f"the field is unoccupied at all {inside.size} points of the first lattice, so there is no surface")
    if inside.all():
        raise FullSurface(
            f"the field is occupied at all {inside.size} points of the first lattice, so it has no surface in the box"
        )
    if widen:
        lattice, values = _widen(evaluator, lattice, values)
    capped = _close_border(values)
    known = np.ones(lattice.shape, dtype=bool)

    while lattice.stride > 1:
        capped |= _complete(evaluator, lattice, values, known)
        cells = mixed_cells(values > 0)
        if lattice.stride > 2:
            grow(cells, dilate)
        lattice, values, known = _split(lattice, values, known)
        wanted = nodes_of_cells(cells.repeat(2, 0).repeat(2, 1).repeat(2, 2))
        wanted &= ~known
        evaluator.fill(lattice, values, wanted)
        known |= wanted
        capped |= _close_border(values)
    capped |= _complete(evaluator, lattice, values, known)
    del known, wanted

    crossings = march(values)
    del values
    vertices = _place(evaluator, lattice, crossings, refine)
    faces = crossings.faces
    vertices, faces, found, kept = keep_components(vertices, faces, keep_share)
    stats = ExtractionStats(
        points=evaluator.points,
        calls=evaluator.calls,
        voxel=float(lattice.spacing),
        components=found,
        kept=kept,
        capped=capped,
        seconds=time.perf_counter() - start,
    )
    return Mesh(vertices, faces, stats=stats)


def _first_lattice(lower: Tensor | np.ndarray, upper: Tensor | np.ndarray, resolution: int, coarse: int) -> Lattice:
    """Return the coarsest lattice: the box with one of its cells around it, centred on it."""
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
    # The small number keeps rounding from adding a layer of cells to a box that is a multiple of a cell.
    cells = np.ceil(size / (spacing * stride) - 1e-6).astype(int) + 2
    origin = (corners[0] + corners[1] - cells * spacing * stride) / 2
    return Lattice(origin=origin, spacing=spacing, stride=stride, shape=tuple(int(n) + 1 for n in cells))


def _widen(evaluator: _Evaluator, lattice: Lattice, values: np.ndarray) -> tuple[Lattice, np.ndarray]:
    """Add cells to the first lattice on the sides where it is occupied, and evaluate them."""
    step = max(1, max(lattice.shape) // (2 * _WIDENINGS))
    for _ in range(_WIDENINGS):
        pads = [tuple(step * bool((values.take(end, axis) > 0).any()) for end in (0, -1)) for axis in range(3)]
        if not np.any(pads):
            break
        wanted = np.pad(np.zeros(lattice.shape, dtype=bool), pads, constant_values=True)
        values = np.pad(values, pads)
        origin = lattice.origin - np.array([before for before, _ in pads]) * lattice.spacing * lattice.stride
        lattice = Lattice(origin, lattice.spacing, lattice.stride, wanted.shape)
        evaluator.fill(lattice, values, wanted)
    return lattice, values


def _split(lattice: Lattice, values: np.ndarray, known: np.ndarray) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """Halve the cells. New nodes take the value of a neighbour until they are evaluated, so their signs are right."""
    finer = lattice.split()
    fine_values = np.empty(finer.shape, dtype=np.float32)
    rows = values.repeat(2, axis=2)[:, :, :-1]
    fine_values[::2, ::2] = rows
    fine_values[::2, 1::2] = rows[:, :-1]
    fine_values[1::2] = fine_values[:-1:2]
    fine_known = np.zeros(finer.shape, dtype=bool)
    fine_known[::2, ::2, ::2] = known
    return finer, fine_values, fine_known


def _complete(evaluator: _Evaluator, lattice: Lattice, values: np.ndarray, known: np.ndarray) -> bool:
    """Evaluate the unknown corners of mixed cells, and around them, until every mixed cell is known.

    Returns:
        True if an occupied node on the border had to be closed.
    """
    capped = False
    while True:
        cells = _unfinished(values, known)
        if cells is None:
            return capped
        grow(cells, 1)
        wanted = nodes_of_cells(cells)
        wanted &= ~known
        evaluator.fill(lattice, values, wanted)
        known |= wanted
        capped |= _close_border(values)


def _unfinished(values: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """Return the mixed cells that have an unknown corner, or None if there are none; slab by slab, to save memory."""
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


def _close_border(values: np.ndarray) -> bool:
    """Make the outermost nodes unoccupied and say whether any of them was not."""
    capped = False
    for axis in range(3):
        for end in (0, -1):
            face = values[(slice(None),) * axis + (end,)]
            if (face > 0).any():
                capped = True
                np.negative(face, out=face, where=face > 0)
    return capped


def _place(evaluator: _Evaluator, lattice: Lattice, crossings: Crossings, refine: int) -> np.ndarray:
    """Return the vertices [V, 3] float32: where the field crosses zero on its lattice edges, by false position."""
    low, high = np.zeros(len(crossings.axis)), np.ones(len(crossings.axis))
    value_low, value_high = crossings.value_a.copy(), crossings.value_b.copy()
    for step in range(refine + 1):
        along = low + (high - low) * (value_low / (value_low - value_high))
        nodes = crossings.node_a.astype(np.float64)
        nodes[np.arange(len(nodes)), crossings.axis] += np.clip(along, MARGIN, 1 - MARGIN)
        vertices = (lattice.origin + nodes * lattice.spacing).astype(np.float32)
        if step < refine:
            value = evaluator.at(vertices).astype(np.float64)
            below = (value > 0) == (value_low > 0)  # the crossing is further along
            low, value_low = np.where(below, along, low), np.where(below, value, value_low)
            high, value_high = np.where(below, high, along), np.where(below, value_high, value)
    return vertices


class _Evaluator:
    """Evaluates the field at lattice nodes, chunk by chunk, and counts."""

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
        """Return field minus level at positions [N, 3] float32, never infinite, [N] float32."""
        out = np.empty(len(positions), dtype=np.float32)
        largest = np.finfo(np.float32).max / 4
        for begin in range(0, len(positions), self.chunk):
            part = slice(begin, begin + self.chunk)
            points = torch.from_numpy(positions[part])
            result = self.field(points)
            if result.shape != points.shape[:1]:
                raise ValueError(f"field: wanted {len(points)} values for as many points, got shape {list(result.shape)}")
            result_np = result.detach().to("cpu", torch.float32).numpy() - np.float32(self.level)
            if np.isnan(result_np).any():
                raise ValueError(f"field: wanted numbers, got NaN at {np.isnan(result_np).sum()} of {len(points)} points")
            out[part] = np.clip(result_np, -largest, largest)
            self.points += len(points)
            self.calls += 1
        return out
