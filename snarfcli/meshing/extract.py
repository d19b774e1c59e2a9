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
from snarfcli.meshing.mesh import ExtractionStats, Mesh, keep_components

__all__ = ["EmptySurface", "FullSurface", "extract_surface"]

# Coarsest lattice, cells along the longest side: for a standing body 3 cm, a finger and a half.
_COARSE = 64
# Cells around the mixed ones that are split as well, on all levels but the last.
_DILATE = 1
# Vertices keep this share of a voxel away from the lattice nodes: no edge shrinks to nothing, so no triangle degenerates
# and the connectivity, which depends on the signs alone, stays as it is. At 256 voxels on 1.7 m: 7 micrometres.
_MARGIN = 1e-3
# Node layers marched at once: bounds the memory, not the result.
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
    coarse: int = _COARSE,
    dilate: int = _DILATE,
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
        coarse: cells along the longest side of the first lattice, at least; features smaller than such a cell that
            are not close to others can be missed.
        dilate: cells around the surface that are split as well, on all levels but the last.
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
    lattice = _first_lattice(lower, upper, resolution, coarse)
    for name, value, least in (("chunk", chunk, 1), ("dilate", dilate, 0)):
        if value < least:
            raise ValueError(f"{name}: wanted at least {least}, got {value}")
    if not 0.0 <= keep_share <= 1.0:
        raise ValueError(f"keep_share: wanted a share between 0 and 1, got {keep_share}")
    evaluator = _Evaluator(field, level, chunk)

    wanted = np.ones(lattice.shape, dtype=bool)
    values = np.empty(lattice.shape, dtype=np.float32)
    evaluator.fill(lattice, values, wanted)
    known = wanted
    inside = values > 0
    if not inside.any():
        raise EmptySurface(
            f"the field is unoccupied at all {inside.size} points of the first lattice, so there is no surface"
        )
    if inside.all():
        raise FullSurface(
            f"the field is occupied at all {inside.size} points of the first lattice, so it has no surface in the box"
        )
    capped = _close_border(values)

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

    vertices_l, faces = _march(values)
    vertices = (lattice.origin + vertices_l * lattice.spacing).astype(np.float32)
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


class _Evaluator:
    """Evaluates the field at lattice nodes, chunk by chunk, and counts."""

    def __init__(self, field: Callable[[Tensor], Tensor], level: float, chunk: int) -> None:
        self.field = field
        self.level = level
        self.chunk = chunk
        self.points = 0
        self.calls = 0

    @torch.no_grad()
    def fill(self, lattice: Lattice, values: np.ndarray, wanted: np.ndarray) -> None:
        """Set `values` at the `wanted` nodes to field minus level, never exactly 0 and never infinite."""
        flat = np.flatnonzero(wanted)
        out = values.reshape(-1)
        largest = np.finfo(np.float32).max / 4
        for begin in range(0, len(flat), self.chunk):
            part = flat[begin : begin + self.chunk]
            points = torch.from_numpy(lattice.positions(part))
            result = self.field(points)
            if result.shape != points.shape[:1]:
                raise ValueError(f"field: wanted {len(part)} values for as many points, got shape {list(result.shape)}")
            result_np = result.detach().to("cpu", torch.float32).numpy() - np.float32(self.level)
            if np.isnan(result_np).any():
                raise ValueError(f"field: wanted numbers, got NaN at {np.isnan(result_np).sum()} of {len(part)} points")
            out[part] = np.clip(result_np, -largest, largest)
            self.points += len(part)
            self.calls += 1


def _march(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run marching cubes on a closed lattice of values and return vertices in node units, float64, and faces.

    scikit-image is given only the signs and returns the middles of edges, exactly; slabs join by these numbers. The classic
    table then gives closed manifolds for any signs (tested on noise), which the topology-aware one does not. The
    vertices move to where the values cross zero, in float64, afterwards.
    """
    from skimage.measure import marching_cubes

    doubled = np.array([2 * n for n in values.shape], dtype=np.int64)
    keys_parts, faces_parts, count = [], [], 0
    for begin in range(0, values.shape[0] - 1, _SLAB):
        slab = values[begin : begin + _SLAB + 1] > 0
        cells = mixed_cells(slab)
        if not cells.any():
            continue
        # Crop to the cells that matter: the empty ones are most of the slab and cost as much.
        box = [np.flatnonzero(cells.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
        offset = np.array([nodes[0] for nodes in box])
        crop = slab[tuple(slice(nodes[0], nodes[-1] + 2) for nodes in box)]
        signs = np.where(crop, np.float32(1), np.float32(-1))
        middles, faces, _, _ = marching_cubes(signs, 0.0, method="lorensen", gradient_direction="ascent")
        twice = np.rint(middles * 2).astype(np.int64) + 2 * (offset + (begin, 0, 0))
        keys_parts.append((twice[:, 0] * doubled[1] + twice[:, 1]) * doubled[2] + twice[:, 2])
        faces_parts.append(faces.astype(np.int64) + count)
        count += len(twice)
    keys, inverse = np.unique(np.concatenate(keys_parts), return_inverse=True)
    faces = inverse.ravel()[np.concatenate(faces_parts)]

    twice = np.stack([keys // (doubled[1] * doubled[2]), keys // doubled[2] % doubled[1], keys % doubled[2]], axis=1)
    node_a = twice // 2
    node_b = (twice + 1) // 2
    value_a = values[tuple(node_a.T)].astype(np.float64)
    value_b = values[tuple(node_b.T)].astype(np.float64)
    along = np.clip(value_a / (value_a - value_b), _MARGIN, 1 - _MARGIN)
    return node_a + along[:, None] * (node_b - node_a), faces.astype(np.int32)
