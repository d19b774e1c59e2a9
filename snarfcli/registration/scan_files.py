"""Read scans as points with normals: points on a mesh, or a point cloud."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError
from snarfcli.formats.surfaces import list_surfaces, read_surface
from snarfcli.sampling.surface import oriented_surface_samples

__all__ = ["FEWEST_POINTS", "ScanFacts", "examine_files", "fingerprint", "list_scans", "read_scan"]

Array = NDArray[np.float64]

FEWEST_POINTS = 500
"""A frame with fewer points says too little about a pose."""


def list_scans(folder: Path) -> list[Path]:
    """Return the scans directly inside a folder, in natural order."""
    return list_surfaces(folder)


def read_scan(path: Path, count: int, seed: int) -> tuple[Array, Array]:
    """Return points [P, 3] and unit normals [P, 3] of a scan, units and axes of the file.

    Args:
        path: the file.
        count: number of points on a mesh, maximum number of a point cloud.
        seed: of the points that are chosen.

    Raises:
        UserError: the file cannot be read, or has numbers that are not finite.
    """
    vertices, faces = read_surface(path)
    return oriented_surface_samples(vertices, faces, count, np.random.default_rng([seed, 1]))


@dataclass(frozen=True)
class ScanFacts:
    """What is known of a file after it was read once."""

    problem: str = ""
    """Why it cannot be used; empty if it can."""
    topology: str = ""
    """Digest of the faces of a mesh and its number of vertices; empty for a point cloud."""


def examine_files(paths: Sequence[Path]) -> Iterator[ScanFacts]:
    """Read files, and yield for each what is known of it."""
    yield from map(_examine, paths)


def _examine(path: Path) -> ScanFacts:
    try:
        vertices, faces = read_surface(path)
    except UserError as error:
        return ScanFacts(str(error))
    if not len(faces) and len(vertices) < FEWEST_POINTS:
        return ScanFacts(f"scan {path}: wanted at least {FEWEST_POINTS} points, got {len(vertices)}")
    digest = hashlib.sha256(f"{len(vertices)} ".encode() + np.ascontiguousarray(faces, "<i8").tobytes())
    return ScanFacts(topology=digest.hexdigest()[:16] if len(faces) else "")


def fingerprint(paths: Sequence[Path]) -> str:
    """Return a digest of the names and sizes of files, which tells whether they have changed."""
    listed = "\n".join(f"{path.name}\0{path.stat().st_size}" for path in paths)
    return hashlib.sha256(listed.encode()).hexdigest()[:16]
