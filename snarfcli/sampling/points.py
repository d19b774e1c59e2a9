"""Occupancy samples of posed meshes: half of them uniform in the papers' cube, half near the surface."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from snarfcli.errors import UserError, nearest
from snarfcli.sampling.cube import CUBE_LEVELS, dequantise, pack_vertices, quantise, sampling_cube
from snarfcli.sampling.occupancy import (
    INSIDE_TESTS,
    check_mesh,
    check_vertices,
    labels_differ,
    ray_parity,
    winding_numbers,
)
from snarfcli.sampling.planar import in_turned_over, outline_samples, with_plane_on_cells
from snarfcli.sampling.surface import POISSON, surface_samples

__all__ = [
    "BrokenFrame",
    "FrameSamples",
    "MeshSequence",
    "SamplingSettings",
    "check_frames",
    "frame_generator",
    "recorded_settings",
    "sample_frame",
    "sample_frames",
]


@dataclass(frozen=True)
class SamplingSettings:
    """How the points of a frame are chosen and labelled."""

    points_per_frame: int
    """Number of points P per frame, a multiple of 8; the first half is uniform in the cube, the rest near the surface."""
    surface_noise_m: float
    """Standard deviation of the isotropic Gaussian noise on the surface points, metres (SNARF section 4.1)."""
    padding: float
    """Added to the longest side of the tight box for the side of the sampling cube, as a share of it."""
    inside_test: str
    """`winding` or `parity`, see `INSIDE_TESTS`."""
    seed: int
    """Seed of all random numbers."""
    poisson: str = "pymeshlab"
    """One of `POISSON`: what spreads points over the surface."""
    is_planar: bool = False
    """Whether the subject is two-dimensional: a prism, sampled only on the plane z = 0 and near its outline there."""

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
        if self.poisson not in POISSON:
            raise UserError(f"poisson: wanted {' or '.join(POISSON)}, got {self.poisson}{nearest(self.poisson, POISSON)}")


def recorded_settings(settings: SamplingSettings) -> dict[str, Any]:
    """Return the settings to record with samples, by name.

    Those that have a default are left out with it: they are newer than the others, and existing samples do not have them.
    """
    return {field.name: value for field in fields(settings) if (value := getattr(settings, field.name)) != field.default}


@dataclass(frozen=True)
class FrameSamples:
    """Labelled points of one posed mesh, and the mesh."""

    points: np.ndarray
    """[P, 3] uint16, quantised in the cube; first half uniform, second half near the surface."""
    occupied: np.ndarray
    """[P] bool, labels of the quantised points."""
    vertices: np.ndarray
    """[V] uint64, vertices of the mesh in the cube, see `pack_vertices`."""
    faces: np.ndarray
    """[F, 3] int32."""
    cube_lower: np.ndarray
    """[3] float32, lower corner of the cube, metres."""
    cube_size: np.float32
    """Side of the cube, metres."""
    box_lower: np.ndarray
    """[3] float32, lower corner of the mesh's tight box, metres."""
    box_upper: np.ndarray
    """[3] float32, upper corner of the mesh's tight box, metres."""
    boundary_edges: int
    """Number of edges at which the mesh is open."""
    differing: int
    """Number of points that the other inside test would label differently; 0 for an open mesh."""


@dataclass(frozen=True)
class BrokenFrame:
    """Stands for a frame that cannot be used; later frames are not read."""

    message: str
    """One line: which mesh, what is wrong, the next step."""


class MeshSequence(Protocol):
    """Posed meshes by index: vertices [V, 3], metres, and outward faces [F, 3]; `source` is the file of one, or empty."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]: ...

    def source(self, index: int) -> str: ...


def frame_generator(seed: int, *names: str | int) -> np.random.Generator:
    """Return the random generator of one frame, which depends on the seed and on the names of subject, sequence and frame."""
    digest = hashlib.sha256("/".join(str(part) for part in (seed, *names)).encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, np.uint32))


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
        vertices: [V, 3], posed, metres.
        faces: [F, 3], vertex indices, outward.
        settings: of the points and their labels.
        generator: from `frame_generator`.
        boundary_edges: number of boundary edges of the mesh; with 0, a closed mesh, both inside tests are compared.
    """
    count = settings.points_per_frame
    is_used = np.zeros(len(vertices), bool)
    is_used[faces] = True
    surface = vertices[is_used]  # unused vertices may lie anywhere
    cube_lower, cube_size = sampling_cube(surface, settings.padding)
    if settings.is_planar:
        cube_lower = with_plane_on_cells(cube_lower, cube_size, CUBE_LEVELS)
    uniform = cube_lower + generator.random((count // 2, 3)) * cube_size
    if settings.is_planar:
        near = outline_samples(vertices, faces, count - count // 2, generator)
    else:
        near = surface_samples(vertices, faces, count - count // 2, generator, settings.poisson)
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
    """Sample posed meshes one by one; the random numbers of each depend on its names and frame number.

    Args:
        meshes: T meshes.
        settings: see `sample_frame`.
        names: identify the sequence, for example by subject and sequence name.
        frames: [T] frame numbers in the sequence.

    Yields:
        The samples of each frame; at the first frame that cannot be used a `BrokenFrame`, and then no more.
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
    """Read posed meshes one by one; yield None for each usable one, and a `BrokenFrame` at the first that is not.

    Args:
        meshes: T meshes.
        inside_test: one of `INSIDE_TESTS`.
        sequence: name of the sequence, for messages.
        frames: [T] frame numbers in the sequence.
    """
    for mesh, _ in _checked_meshes(meshes, inside_test, sequence, frames):
        yield mesh if isinstance(mesh, BrokenFrame) else None


def _checked_meshes(
    meshes: MeshSequence, inside_test: str, sequence: str, frames: Sequence[int]
) -> Iterator[tuple[tuple[np.ndarray, np.ndarray, int] | BrokenFrame, str]]:
    """Yield vertices, faces and number of boundary edges of each mesh, and its name in messages, until one is broken."""
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
