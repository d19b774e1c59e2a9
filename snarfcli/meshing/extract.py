"""Watertight surfaces of fields: coarse-to-fine evaluation and marching cubes.

The field is evaluated on a coarse lattice first. Cells whose corners differ in sign, and their neighbours, are split in two
along each axis and evaluated again, down to the requested resolution (MISE: Mescheder et al., Occupancy Networks, CVPR 2019,
section 3.3). Then the unknown corners of cells with mixed signs are evaluated, and so on outwards, until no surface ends at
the edge of the evaluated region. Except for features that the coarse lattice misses, the mesh equals that of the full lattice.

All of it runs on the device of the points, up to the finished vertices, faces and normals.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from snarfcli.meshing.components import keep_components
from snarfcli.meshing.descent import Descent, descend, evaluate_nodes, occupied_sides
from snarfcli.meshing.evaluator import Evaluator
from snarfcli.meshing.lattice import Lattice, first_lattice, flat_indices
from snarfcli.meshing.marching import MARGIN, Crossings, march
from snarfcli.meshing.mesh import ExtractionStats, Mesh, normals_at_vertices
from snarfcli.models.in_parts import points_at_once

__all__ = ["EmptySurface", "FullSurface", "extract_surface"]

# Minimum and maximum number of cells of the first lattice along the longest side, by default a quarter of the resolution. 64
# are 3 cm on a standing body. Thin parts that join a part found by the first lattice are followed, so this matters only for
# loose parts.
_COARSE = (32, 64)
# Width, in cells, of the layer around mixed cells that is split as well, on all levels but the last.
_DILATE = 1
# Maximum number of times that a box is widened, each time by a sixteenth of its longest side.
_WIDENINGS = 8


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
    chunk: int | None = None,
    device: torch.device | str = "cpu",
) -> Mesh:
    """Extract the surface where `field` crosses `level` in a box, as a closed mesh of outward triangles.

    Args:
        field: points [N, 3] float32 on `device` -> values [N] on any device; occupied where above `level`. Infinite
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
        chunk: maximum number of points per call of the field; None: 65,536 on a CPU, 262,144 on a GPU.
        device: where the points are made and the mesh is computed; best that of the field.

    Returns:
        The mesh in the frame of the box, with `normals` and `stats`. A surface that leaves the box is closed at its border.

    Raises:
        EmptySurface: no evaluated point is occupied.
        FullSurface: all evaluated points are occupied.
        ValueError: an argument is out of range, or the field returns a wrong shape.
        UserError: the field returns NaN.
    """
    start, device = time.perf_counter(), torch.device(device)
    if chunk is None:
        chunk = points_at_once(device)
    if coarse is None:
        coarse = min(max(resolution // 4, _COARSE[0]), _COARSE[1])
    lattice = first_lattice(lower, upper, resolution, coarse)
    for name, value, least in (("chunk", chunk, 1), ("dilate", dilate, 0), ("refine", refine, 0)):
        if value < least:
            raise ValueError(f"{name}: wanted at least {least}, got {value}")
    if not 0.0 <= keep_share <= 1.0:
        raise ValueError(f"keep_share: wanted a share between 0 and 1, got {keep_share}")
    evaluator = Evaluator(field, level, chunk, device)

    descent = _evaluate(evaluator, lattice, dilate, _WIDENINGS if widen else 0)
    final = descent.lattice
    crossings = march(final, descent.inside, descent.values)
    vertices = _place(evaluator, final, crossings, refine)
    vertices, faces, found, kept = keep_components(vertices, crossings.faces, keep_share)
    normals = normals_at_vertices(vertices, faces)
    (sides,) = evaluator.read(descent.occupied_sides())
    arrays = [tensor.cpu().numpy() for tensor in (vertices, faces.int(), normals)]
    stats = ExtractionStats(
        points=evaluator.points,
        calls=evaluator.calls,
        voxel=final.spacing,
        components=found,
        kept=kept,
        capped=any(sides),
        seconds=time.perf_counter() - start,
    )
    return Mesh(arrays[0], arrays[1], normals=arrays[2], stats=stats)


def _evaluate(evaluator: Evaluator, lattice: Lattice, dilate: int, widenings: int) -> Descent:
    """Evaluate the field, on lattices that are widened up to `widenings` times while a side is occupied.

    Raises:
        EmptySurface: no point of the first lattice is occupied.
        FullSurface: all its points are occupied.
    """
    every = torch.arange(lattice.size, device=evaluator.device)
    values = evaluate_nodes(evaluator, lattice, every).view(lattice.shape)
    inside = values > 0
    (some, full), sides = evaluator.read(torch.stack([inside.any(), inside.all()]), occupied_sides(values))
    if not some:
        raise EmptySurface(f"the field is unoccupied at all {lattice.size} points of the first lattice, so there is no surface")
    if full:
        raise FullSurface(
            f"the field is occupied at all {lattice.size} points of the first lattice, so it has no surface in the box"
        )
    for _ in range(widenings):
        if not any(sides):
            descent = descend(evaluator, lattice, values, dilate)
            (sides,) = evaluator.read(descent.occupied_sides())
            if not any(sides):
                return descent
        lattice, values = _widen(evaluator, lattice, values, np.reshape(sides, (3, 2)))
        (sides,) = evaluator.read(occupied_sides(values))
    return descend(evaluator, lattice, values, dilate)


def _widen(evaluator: Evaluator, lattice: Lattice, values: Tensor, sides: np.ndarray) -> tuple[Lattice, Tensor]:
    """Add cells to the first lattice on some sides, bool [3, 2], and evaluate them."""
    pads = sides * max(1, max(lattice.shape) // (2 * _WIDENINGS))
    shape = tuple(int(nodes + pad.sum()) for nodes, pad in zip(lattice.shape, pads, strict=True))
    former = tuple(slice(int(before), int(before) + nodes) for nodes, (before, _) in zip(lattice.shape, pads, strict=True))
    origin = np.array(lattice.origin) - pads[:, 0] * lattice.spacing * lattice.stride
    lattice = Lattice(tuple(origin.tolist()), lattice.spacing, lattice.stride, shape)
    wanted = torch.ones(shape, dtype=torch.bool, device=values.device)
    wanted[former] = False
    flat = flat_indices(wanted)
    wider = values.new_empty(shape)
    wider[former] = values
    wider.view(-1)[flat] = evaluate_nodes(evaluator, lattice, flat)
    return lattice, wider


def _place(evaluator: Evaluator, lattice: Lattice, crossings: Crossings, refine: int) -> Tensor:
    """Return the vertices [V, 3] float32: the zeros of the field on the lattice edges, by false position."""
    low, high = torch.zeros_like(crossings.value_a), torch.ones_like(crossings.value_b)
    value_low, value_high = crossings.value_a, crossings.value_b
    direction = torch.stack([crossings.axis == axis for axis in range(3)], dim=1)
    for step in range(refine + 1):
        along = low + (high - low) * (value_low / (value_low - value_high))
        shift = direction * along.clamp(MARGIN, 1 - MARGIN)[:, None]
        vertices = lattice.positions(crossings.node_a + shift)
        if step < refine:
            value = evaluator.at(vertices).double()
            below = (value > 0) == (value_low > 0)  # the zero is further along
            low, value_low = torch.where(below, along, low), torch.where(below, value, value_low)
            high, value_high = torch.where(below, high, along), torch.where(below, value_high, value)
    return vertices
