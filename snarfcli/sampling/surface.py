"""Points on the surface of a triangle mesh: spread evenly, or uniformly at random."""

from __future__ import annotations

import logging

import numpy as np

from snarfcli.errors import UserError, nearest
from snarfcli.extras.meshlab import INSTALL_MESHLAB, why_no_meshlab
from snarfcli.sampling.disks import poisson_disks
from snarfcli.sampling.triangles import area_normals, random_points_in, uniform_in_triangles

__all__ = ["POISSON", "choose_poisson", "oriented_surface_samples", "surface_samples", "uniform_surface_samples"]

log = logging.getLogger(__name__)

POISSON = ("pymeshlab", "own")
"""`pymeshlab`: MeshLab, whose licence is GPL-3. `own`: `poisson_disks`, with the same spacing, in 1.5 times the time."""

# MeshLab draws this number of candidates per sample and keeps those that are a disk apart. Its defaults (20, and the best of
# 10 per cell) take 5 times as long; the spacing then varies by 7 % instead of 10 %, which noise as wide as the spacing hides.
_POISSON_OPTIONS = {"montecarlorate": 6, "bestsampleflag": False}
_POISSON_REQUEST = 0.93  # with these options MeshLab returns 1.11 times the requested number, which leaves some 3 % to spare
_THINNEST = 1e-7  # spacing of samples to length of the mesh; below 1e-10 MeshLab does not return (32-bit cells)


def choose_poisson(choice: str) -> str:
    """Return the program that draws Poisson-disk samples, one of `POISSON`.

    Args:
        choice: one of them, or auto: MeshLab if it can be used. A line in the log says why if it cannot.

    Raises:
        UserError: it is none of these, or cannot be used.
    """
    if choice not in ("auto", *POISSON):
        wanted = ", ".join(("auto", *POISSON))
        raise UserError(f"poisson: wanted one of {wanted}, got {choice!r}{nearest(choice, ('auto', *POISSON))}")
    if choice == "own":
        return choice
    reason = why_no_meshlab()
    if reason is None:
        return "pymeshlab"
    if choice == "pymeshlab":
        raise UserError(f"poisson: wanted MeshLab, but {reason}; give poisson=own, or install it with: {INSTALL_MESHLAB}")
    log.info("surface points are spread by snarf's own code, since %s (poisson=own)", reason)
    return "own"


def surface_samples(
    vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator, poisson: str = "pymeshlab"
) -> np.ndarray:
    """Return `count` points spread evenly over a surface: Poisson-disk samples.

    The number of disks is met only roughly, so a few samples are dropped at random, or drawn uniformly in addition. MeshLab's
    random state cannot be set: the same call gives the same points only as the first call in its process.

    Args:
        vertices: [V, 3], metres.
        faces: [F, 3], vertex indices.
        count: number of points.
        generator: chooses the points that are dropped or added; with `own` all points.
        poisson: one of `POISSON`.

    Returns:
        [count, 3] float64, metres, in random order.

    Raises:
        UserError: the surface has no area, or next to none for its length.
    """
    corners, areas = _triangles(vertices, faces)
    length = float(np.ptp(vertices, axis=0).max())
    if np.sqrt(areas.sum() / max(1, count)) < _THINNEST * length:
        size = f"{areas.sum():.3g} m^2, {length:.3g} m long"
        raise UserError(f"mesh has next to no area ({size}), so nothing can be sampled on its surface; repair this frame")
    disks = poisson_disks(corners, areas, count, generator) if poisson == "own" else _meshlab_disks(vertices, faces, count)
    points = generator.permutation(disks)[:count]
    missing = count - len(points)
    if missing:
        points = np.concatenate([points, uniform_in_triangles(corners, areas, missing, generator)])
    return points


def _meshlab_disks(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Return about `count` Poisson-disk samples by MeshLab, [about count, 3] float64, metres."""
    import pymeshlab  # here: loading it takes 0.2 s, which processes that draw only uniform points save

    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]  # defined in its extension module, without stubs
    meshes.add_mesh(pymeshlab.Mesh(vertices.astype(np.float64), faces.astype(np.int32)))  # pyright: ignore[reportAttributeAccessIssue]
    meshes.generate_sampling_poisson_disk(samplenum=max(1, round(count * _POISSON_REQUEST)), **_POISSON_OPTIONS)
    return meshes.current_mesh().vertex_matrix()


def uniform_surface_samples(vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return `count` independent, uniform points on a surface: 50 times as fast as `surface_samples`, less evenly spread.

    Args:
        vertices: [V, 3], metres.
        faces: [F, 3], vertex indices.
        count: number of points.
        generator: source of random numbers.

    Returns:
        [count, 3] float64, metres.

    Raises:
        UserError: the surface has no area.
    """
    return uniform_in_triangles(*_triangles(vertices, faces), count, generator)


def oriented_surface_samples(
    vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` independent, uniform points on a surface, and the normals there.

    Args:
        vertices: [V, 3], metres.
        faces: [F, 3], vertex indices.
        count: number of points.
        generator: source of random numbers.

    Returns:
        Points [count, 3], metres, and unit normals [count, 3], both float64.

    Raises:
        UserError: the surface has no area.
    """
    corners, areas = _triangles(vertices, faces)
    chosen = generator.choice(len(areas), count, p=areas / areas.sum())
    normals = area_normals(corners[chosen]) / (2 * areas[chosen, None])
    return random_points_in(corners[chosen], generator), normals


def _triangles(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [F, 3, 3] and areas [F] of a mesh's triangles; raise UserError if they have no area."""
    corners = vertices.astype(np.float64)[faces]
    areas = np.linalg.norm(area_normals(corners), axis=1) / 2
    if not areas.sum() > 0:
        raise UserError("mesh has no area, so nothing can be sampled on its surface; leave this frame out")
    return corners, areas
