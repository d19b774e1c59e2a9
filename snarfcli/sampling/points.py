"""Occupancy samples of one posed mesh: half of them uniform in the papers' box, half near the surface."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from snarfcli.errors import UserError, nearest
from snarfcli.sampling.occupancy import (
    INSIDE_TESTS,
    check_mesh,
    check_vertices,
    labels_differ,
    ray_parity,
    winding_numbers,
)
from snarfcli.sampling.planar import in_turned_over, outline_samples, with_plane_on_cells

__all__ = [
    "CUBE_PADDING",
    "BrokenFrame",
    "FrameSamples",
    "SamplingSettings",
    "check_frames",
    "dequantise",
    "frame_generator",
    "pack_vertices",
    "quantise",
    "sample_frame",
    "sample_frames",
    "sampling_cube",
    "surface_samples",
    "uniform_surface_samples",
    "unpack_vertices",
]

CUBE_PADDING = 0.1
"""The papers' box is a cube around the mesh whose side is the longest side of the tight box times 1.1."""

_LEVELS = 65536  # uint16; in a cube of 2 m the steps are 30 micrometres
_VERTEX_BITS = 21  # three of them fit a uint64
_VERTEX_LEVELS = 1 << _VERTEX_BITS
# MeshLab draws this many candidates for each sample and keeps those that are a disk apart. Its defaults (20, and the best
# of 10 in each cell) take 5 times as long; the spacing varies by 7 % then and by 10 % so, below noise as wide as the spacing.
_POISSON_OPTIONS = {"montecarlorate": 6, "bestsampleflag": False}
_POISSON_REQUEST = 0.93  # with these options it gives 1.11 times the samples asked for: some 3 % to spare
_THINNEST = 1e-7  # distance of samples to length of the mesh; MeshLab never comes back from below 1e-10 (32-bit cells)


@dataclass(frozen=True)
class SamplingSettings:
    """How the points of every frame are chosen and labelled."""

    points_per_frame: int
    """Number of points P of a frame, a multiple of 8; the first half is uniform in the cube, the rest near the surface."""
    surface_noise_m: float
    """Standard deviation of the isotropic Gaussian noise on the surface points, metres (SNARF section 4.1)."""
    padding: float
    """How much longer the sampling cube is than the longest side of the tight box, as a share."""
    inside_test: str
    """`winding` or `parity`."""
    seed: int
    """Start of all random numbers."""
    is_planar: bool = False
    """Whether the subject is two-dimensional: a prism, sampled on the plane z = 0 alone and near its outline there."""

    def __post_init__(self) -> None:
        if self.points_per_frame < 8 or self.points_per_frame % 8:
            raise UserError(f"points_per_frame: wanted a positive multiple of 8, got {self.points_per_frame}")
        if not 0.0 <= self.surface_noise_m < float("inf"):
            raise UserError(f"surface_noise_m: wanted a length in metres, zero or more, got {self.surface_noise_m}")
        if not 0.0 <= self.padding < float("inf"):
            raise UserError(f"padding: wanted a share, zero or more, got {self.padding}")
        if self.inside_test not in INSIDE_TESTS:
            raise UserError(
                f"inside_test: wanted {' or '.join(INSIDE_TESTS)}, got {self.inside_test}"
                f"{nearest(self.inside_test, INSIDE_TESTS)}"
            )


@dataclass(frozen=True)
class FrameSamples:
    """Labelled points of one posed mesh, and the mesh itself."""

    points: np.ndarray
    """[P, 3] uint16, quantised in the cube; first half uniform, second half near the surface."""
    occupied: np.ndarray
    """[P] bool, labels of the quantised points."""
    vertices: np.ndarray
    """[V] uint64, the mesh's vertices in the cube, see `pack_vertices`."""
    faces: np.ndarray
    """[F, 3] int32."""
    cube_lower: np.ndarray
    """[3] float32, the cube's corner, metres."""
    cube_size: np.float32
    """The cube's side, metres."""
    box_lower: np.ndarray
    """[3] float32, lower corner of the mesh's tight box, metres."""
    box_upper: np.ndarray
    """[3] float32, upper corner of the mesh's tight box, metres."""
    boundary_edges: int
    """Number of edges at which the mesh is open."""
    differing: int
    """Number of points that the other inside test would label differently (closed meshes; 0 for open ones)."""


@dataclass(frozen=True)
class BrokenFrame:
    """What comes instead of the samples of a frame that cannot be used; the frames after it are not looked at."""

    message: str
    """One line: which mesh, what is wrong, what to do."""


class MeshSequence(Protocol):
    """Posed meshes: vertices [V, 3], metres, and outward faces [F, 3]."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]: ...

    def source(self, index: int) -> str: ...


def frame_generator(seed: int, *names: str | int) -> np.random.Generator:
    """Return the random generator of one frame, a function of the seed and of the names of subject, sequence, frame."""
    digest = hashlib.sha256("/".join(str(part) for part in (seed, *names)).encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, np.uint32))


def sampling_cube(vertices: np.ndarray, padding: float = CUBE_PADDING) -> tuple[np.ndarray, np.float32]:
    """Return the papers' sampling cube of a posed mesh.

    Args:
        vertices: [V, 3] metres.
        padding: how much longer the cube is than the longest side of the tight box, as a share.

    Returns:
        Its lower corner [3] and its side, float32, metres.
    """
    lower, upper = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
    size = (upper - lower).max() * (1.0 + padding)
    return ((lower + upper - size) / 2).astype(np.float32), np.float32(size)


def quantise(points: np.ndarray, cube_lower: np.ndarray, cube_size: float) -> np.ndarray:
    """Return the uint16 cells in which points lie; a point outside the cube goes to the nearest cell of its border.

    Args:
        points: [..., 3] metres.
        cube_lower: [3] metres.
        cube_size: metres.
    """
    cells = np.floor((points - cube_lower) * (_LEVELS / np.float64(cube_size)))
    return np.clip(cells, 0, _LEVELS - 1).astype(np.uint16)


def dequantise(cells: np.ndarray, cube_lower: np.ndarray, cube_size: np.ndarray | float) -> np.ndarray:
    """Return the float32 centres of uint16 cells. Labels are made for exactly these points, so nothing is lost.

    Args:
        cells: [..., 3] uint16.
        cube_lower: [..., 3] float32, metres, broadcast against `cells`.
        cube_size: [..., 1] or a number, float32, metres.
    """
    step = np.asarray(cube_size, np.float32) / np.float32(_LEVELS)
    return (cells.astype(np.float32) + np.float32(0.5)) * step + np.asarray(cube_lower, np.float32)


def pack_vertices(vertices: np.ndarray, cube_lower: np.ndarray, cube_size: float) -> np.ndarray:
    """Return vertices [V, 3], metres, as one uint64 each [V]: 21 bits an axis, in a cube of 2 m right to half a micrometre.

    The mesh stays finer than the 16 bits of the points, for which no label would be wrong beyond 0.01 mm from the surface.
    """
    cells = np.floor((np.asarray(vertices, np.float64) - cube_lower) * (_VERTEX_LEVELS / np.float64(cube_size)))
    x, y, z = np.clip(cells, 0, _VERTEX_LEVELS - 1).astype(np.uint64).T
    return x | y << np.uint64(_VERTEX_BITS) | z << np.uint64(2 * _VERTEX_BITS)


def unpack_vertices(packed: np.ndarray, cube_lower: np.ndarray, cube_size: float) -> np.ndarray:
    """Return the vertices [V, 3] float32, metres, that `pack_vertices` packed."""
    shifts = np.array([0, _VERTEX_BITS, 2 * _VERTEX_BITS], np.uint64)
    cells = (packed[:, None] >> shifts) & np.uint64(_VERTEX_LEVELS - 1)
    step = np.float64(cube_size) / _VERTEX_LEVELS
    return ((cells.astype(np.float64) + 0.5) * step + cube_lower).astype(np.float32)


def surface_samples(vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return `count` points spread evenly over a surface: Poisson-disk samples by MeshLab.

    MeshLab hits the count only roughly, so a few samples are dropped at random, or drawn uniformly in addition. It also
    has a random state of its own that cannot be set: the same call gives the same points only as the first of its process.

    Args:
        vertices: [V, 3] metres.
        faces: [F, 3] vertex numbers.
        count: number of points.
        generator: chooses what is dropped or added.

    Returns:
        [count, 3] float64, metres, in random order.

    Raises:
        UserError: the surface has no area, or next to none for its length.
    """
    import pymeshlab

    corners, areas = _triangles(vertices, faces)
    length = float(np.ptp(vertices, axis=0).max())
    if np.sqrt(areas.sum() / max(1, count)) < _THINNEST * length:
        size = f"{areas.sum():.3g} m^2, {length:.3g} m long"
        raise UserError(f"mesh has next to no area ({size}), so nothing can be sampled on its surface; repair this frame")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices.astype(np.float64), faces.astype(np.int32)))
    meshes.generate_sampling_poisson_disk(samplenum=max(1, round(count * _POISSON_REQUEST)), **_POISSON_OPTIONS)
    points = generator.permutation(meshes.current_mesh().vertex_matrix())[:count]
    missing = count - len(points)
    if missing:
        points = np.concatenate([points, _uniform_in_triangles(corners, areas, missing, generator)])
    return points


def uniform_surface_samples(vertices: np.ndarray, faces: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return `count` independent points, uniform on a surface: in a fiftieth of the time of `surface_samples`, less even.

    Args:
        vertices: [V, 3] metres.
        faces: [F, 3] vertex numbers.
        count: number of points.
        generator: draws them.

    Returns:
        [count, 3] float64, metres.

    Raises:
        UserError: the surface has no area.
    """
    return _uniform_in_triangles(*_triangles(vertices, faces), count, generator)


def _triangles(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [F, 3, 3] of a mesh's triangles and their areas [F]; refuse a mesh without area."""
    corners = vertices.astype(np.float64)[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    if not areas.sum() > 0:
        raise UserError("mesh has no area, so nothing can be sampled on its surface; leave this frame out")
    return corners, areas


def _uniform_in_triangles(corners: np.ndarray, areas: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return `count` points [count, 3], uniform on triangles."""
    chosen = generator.choice(len(areas), count, p=areas / areas.sum())
    first, second = generator.random((2, count, 1))
    root = np.sqrt(first)  # uniform in a triangle: Osada et al., Shape Distributions, 2002, Eq. 1
    a, b, c = corners[chosen].transpose(1, 0, 2)
    return (1 - root) * a + root * (1 - second) * b + root * second * c


def sample_frame(
    vertices: np.ndarray,
    faces: np.ndarray,
    settings: SamplingSettings,
    generator: np.random.Generator,
    *,
    boundary_edges: int = 0,
) -> FrameSamples:
    """Sample labelled points of one posed mesh (SNARF section 4.1; the cube is its released code's).

    Args:
        vertices: [V, 3] metres, posed.
        faces: [F, 3] vertex numbers, outward.
        settings: how many points, and how they are chosen and labelled.
        generator: from `frame_generator`.
        boundary_edges: of the mesh; 0 says that it is closed, so that both inside tests can be compared.
    """
    count = settings.points_per_frame
    is_used = np.zeros(len(vertices), bool)
    is_used[faces] = True
    surface = vertices[is_used]  # what no face uses may lie anywhere
    cube_lower, cube_size = sampling_cube(surface, settings.padding)
    if settings.is_planar:
        cube_lower = with_plane_on_cells(cube_lower, cube_size, _LEVELS)
    uniform = cube_lower + generator.random((count // 2, 3)) * cube_size
    spread = outline_samples if settings.is_planar else surface_samples
    near = spread(vertices, faces, count - count // 2, generator)
    near = near + generator.normal(scale=settings.surface_noise_m, size=near.shape)
    chosen = np.concatenate([uniform, near])
    if settings.is_planar:
        chosen[:, 2] = 0.0
    cells = quantise(chosen, cube_lower, cube_size)
    points = dequantise(cells, cube_lower, cube_size)
    winding = winding_numbers(vertices, faces, points)
    by_parity = settings.inside_test == "parity"
    occupied = ray_parity(vertices, faces, points) if by_parity else winding > 0.5
    if settings.is_planar and not by_parity:
        occupied |= in_turned_over(vertices, faces, points)
    return FrameSamples(
        points=cells,
        occupied=occupied,
        vertices=pack_vertices(vertices, cube_lower, cube_size),
        faces=faces.astype(np.int32),
        cube_lower=cube_lower,
        cube_size=cube_size,
        box_lower=surface.min(axis=0).astype(np.float32),
        box_upper=surface.max(axis=0).astype(np.float32),
        boundary_edges=boundary_edges,
        differing=int(labels_differ(winding).sum()) if boundary_edges == 0 else 0,
    )


def sample_frames(
    meshes: MeshSequence, settings: SamplingSettings, names: Sequence[str], frames: Sequence[int]
) -> Iterator[FrameSamples | BrokenFrame]:
    """Sample one posed mesh after another; the random numbers of each depend on its own names and frame number.

    Args:
        meshes: T meshes.
        settings: see `sample_frame`.
        names: what tells this sequence from others, such as subject and sequence name.
        frames: [T] frame numbers within the sequence.

    Yields:
        The samples of each frame, or what is wrong with the first one that cannot be used.
    """
    for index, (mesh, where) in enumerate(_checked_meshes(meshes, settings.inside_test, names[-1], frames)):
        if isinstance(mesh, BrokenFrame):
            yield mesh
            return
        vertices, faces, boundary_edges = mesh
        generator = frame_generator(settings.seed, *names, int(frames[index]))
        try:
            samples = sample_frame(vertices, faces, settings, generator, boundary_edges=boundary_edges)
        except UserError as error:
            yield BrokenFrame(f"{where}: {error}")
            return
        yield samples


def check_frames(meshes: MeshSequence, inside_test: str, sequence: str, frames: Sequence[int]) -> Iterator[BrokenFrame | None]:
    """Read one posed mesh after another, and yield None for each that can be used, or what is wrong with the first that cannot.

    Args:
        meshes: T meshes.
        inside_test: one of `INSIDE_TESTS`.
        sequence: its name, for messages.
        frames: [T] frame numbers within the sequence.
    """
    for mesh, _ in _checked_meshes(meshes, inside_test, sequence, frames):
        yield mesh if isinstance(mesh, BrokenFrame) else None


def _checked_meshes(
    meshes: MeshSequence, inside_test: str, sequence: str, frames: Sequence[int]
) -> Iterator[tuple[tuple[np.ndarray, np.ndarray, int] | BrokenFrame, str]]:
    """Yield vertices, faces and number of boundary edges of each mesh, and what to call it, until one is broken."""
    checked: np.ndarray | None = None
    boundary_edges = 0
    for index, frame in enumerate(frames):
        file = meshes.source(index)
        where = f"{sequence}, frame {frame}" + (f" ({file})" if file else "")
        try:
            vertices, faces = meshes[index]
            if checked is None or faces is not checked:
                boundary_edges = check_mesh(vertices, faces, inside_test, f"{where}: the mesh")
                checked = faces
            else:
                check_vertices(vertices, f"{where}: the mesh")
        except UserError as error:
            yield BrokenFrame(str(error)), where
            return
        yield (vertices, faces, boundary_edges), where
