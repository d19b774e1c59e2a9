"""Read scans as points with normals: points on a mesh, or a point cloud."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli import point_clouds
from snarfcli.errors import UserError
from snarfcli.files import file_digest
from snarfcli.point_clouds import PointFile, estimate_normals, read_frame
from snarfcli.sampling.surface import oriented_surface_samples

__all__ = ["FEWEST_POINTS", "OrientedScan", "ScanFacts", "examine_files", "fingerprint", "read_scan", "topology_of"]

Array = NDArray[np.float64]

FEWEST_POINTS = 500
"""A frame with fewer points says too little about a pose."""


@dataclass(frozen=True)
class ScanFacts:
    """What is known of a file after it was read once."""

    problem: str = ""
    """Why it cannot be used; empty if it can."""
    topology: str = ""
    """Digest of the faces of a mesh and its number of vertices; empty for a point cloud."""
    content: str = ""
    """Digest of the content of the file; empty if it cannot be read."""


@dataclass(frozen=True)
class OrientedScan:
    """The points of a file with normals, units and axes of the file."""

    points: Array
    """[P, 3]."""
    normals: Array
    """[P, 3], unit length."""
    change: str = ""
    """What was wrong with the normals, for messages; empty if nothing was."""
    is_estimated: bool = False
    """Whether the normals are estimated from the points."""


def read_scan(path: Path, count: int, seed: int, *, check_normals: bool = False) -> OrientedScan:
    """Return points on a mesh, or of a point cloud.

    Args:
        path: the file.
        count: number of points on a mesh, maximum number of a point cloud.
        seed: of the points that are chosen.
        check_normals: whether the normals of a point cloud are compared with those of planes through its points; takes as
            long as fitting a pose. Otherwise they are taken as they are. Missing ones are estimated in any case.

    Raises:
        UserError: the file cannot be read, or has numbers that are not finite.
    """
    frame = read_frame(path)
    draws = np.random.default_rng([seed, 1])
    if not isinstance(frame, PointFile):
        return OrientedScan(*oriented_surface_samples(*frame, count, draws))
    chosen = draws.permutation(len(frame.points))[:count]
    points = frame.points[chosen]
    if frame.normals is None:
        return OrientedScan(points, estimate_normals(points), is_estimated=True)
    normals = np.nan_to_num(frame.normals[chosen], posinf=0.0, neginf=0.0)
    if check_normals:
        checked = point_clouds.check_normals(points, normals)
        return OrientedScan(points, checked.normals, checked.change, checked.is_estimated)
    return OrientedScan(points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))


def examine_files(paths: Sequence[Path]) -> Iterator[ScanFacts]:
    """Read files, and yield for each what is known of it."""
    yield from map(_examine, paths)


def _examine(path: Path) -> ScanFacts:
    try:
        frame, content = read_frame(path), file_digest(path)
    except UserError as error:
        return ScanFacts(str(error))
    if not isinstance(frame, PointFile):
        return ScanFacts(topology=topology_of(len(frame[0]), frame[1]), content=content)
    count = len(frame.points)
    problem = f"scan {path}: wanted at least {FEWEST_POINTS} different points, got {count}" if count < FEWEST_POINTS else ""
    return ScanFacts(problem, content=content)


def topology_of(vertices: int, faces: NDArray) -> str:
    """Return a digest of a number of vertices and faces [F, 3], the same for the same topology."""
    return hashlib.sha256(f"{vertices} ".encode() + np.ascontiguousarray(faces, "<i8").tobytes()).hexdigest()[:16]


def fingerprint(paths: Sequence[Path], facts: Sequence[ScanFacts]) -> str:
    """Return a digest of the names and contents of scans, which tells whether they have changed."""
    listed = "\n".join(f"{path.name}\0{one.content}" for path, one in zip(paths, facts, strict=True))
    return hashlib.sha256(listed.encode()).hexdigest()[:16]
