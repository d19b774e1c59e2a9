"""The scans of a subject: the files of its sequences, and their frames as points in metres with y up.

A sequence is a folder with one file per frame, in natural order: meshes, or point clouds (a `.ply` or `.obj` without faces, an
`.npz` with `points` and perhaps `normals`, `.npy`, `.xyz`). A subject is a folder of such folders, or one such folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.datasets.mesh_folders import frame_files, meshes_folder, rigged_files, skeleton_files, subfolders
from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.datasets.rigged import read_rigged_files
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError, nearest
from snarfcli.formats.surfaces import read_surface
from snarfcli.names import folder_names
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.scanned_subjects.scan_files import read_scan
from snarfcli.scanned_subjects.surroundings import Floor, without_surroundings

__all__ = ["ScanFolder", "ScanSequence", "find_scans", "scan_subjects"]

Array = NDArray[np.float64]

_SOMEBODY = 100  # points beside floor and other things, with fewer of which the subject is not in a frame
_SPARE = 1.2  # times the points that are needed are read, since the share of the subject varies
_MOST_POINTS = 200_000
_WANTED = "<subject>/<sequence>/ with one mesh or point cloud per frame"


@dataclass(frozen=True)
class ScanFolder:
    """The files of one sequence."""

    name: str
    """Name of the sequence."""
    folder: Path
    """Where the poses are written."""
    paths: tuple[Path, ...]
    """One file per frame, in order."""


@dataclass(frozen=True)
class ScanSequence:
    """The frames of one sequence as points, read when they are asked for; can be sent to other processes."""

    paths: tuple[Path, ...]
    """One file per frame."""
    world: FileToWorld
    """Conversion to metres and y up."""
    count: int
    """Maximum number of points of a frame."""
    floor: Floor | None = None
    """Floor in the scans, units and axes of the files."""
    has_parts: bool = False
    """Whether other things stand apart from the subject."""
    share: float = 1.0
    """Share of the points that is on the subject."""
    checks_normals: bool = False
    """Whether the normals of point clouds are wrong in some frames."""
    seed: int = 0
    """Of the points that are chosen."""

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> ScanPoints:
        """Return the points of one frame.

        Raises:
            UserError: the file cannot be read; the message names it.
        """
        path = self.paths[index]
        count = min(_MOST_POINTS, round(self.count * _SPARE / self.share)) if self.share < 1 else self.count
        scan = read_scan(path, count, self.seed + index, check_normals=self.checks_normals)
        points, normals = scan.points, scan.normals
        subject = without_surroundings(points, normals, self.floor, has_parts=self.has_parts)
        if len(subject[0]) >= _SOMEBODY:  # else the subject is not in this frame, which its residual will show
            points, normals = subject
        if _is_inside_out(points, normals):
            normals = -normals
        points, normals = self.world.points(points), normals @ self.world.turn.T
        return ScanPoints.sampled(points, normals, self.count, self.seed + index, is_estimated=scan.is_estimated)

    def vertices(self, index: int) -> Array:
        """Return the vertices [V, 3] of the mesh of one frame, metres, y up, with all that it shows.

        Raises:
            UserError: the file cannot be read.
        """
        return self.world.points(read_surface(self.paths[index])[0])

    def faces(self) -> NDArray[np.int64]:
        """Return the faces [F, 3] of the mesh of the first frame."""
        return read_surface(self.paths[0])[1]

    def chosen(self, frames: Sequence[int]) -> ScanSequence:
        """Return the sequence with some of its frames."""
        return replace(self, paths=tuple(self.paths[frame] for frame in frames))


def scan_subjects(request: Request) -> dict[str, Path]:
    """Return the folder of each subject that has scans, by name.

    The request may also name the folder of one subject: one with a skeleton or scans, or whose folders all have scans.

    Raises:
        UserError: there is no folder.
    """
    folder = meshes_folder(request, _WANTED)
    whole, found = {folder.absolute().name: folder}, _folders_with_scans(folder)
    if skeleton_files(folder) or frame_files(folder):
        return whole
    is_one = request.config.folder is not None and found and all(frame_files(path) for path in found.values())
    return whole if is_one else found


def find_scans(subject: str, request: Request) -> tuple[Path, list[ScanFolder]]:
    """Return the folder of a subject, and its sequences by name.

    Raises:
        UserError: there is no such subject, it has no scans, or it is a rigged file that has its own motion.
    """
    folder = meshes_folder(request, _WANTED)
    places = scan_subjects(request)
    places = places if subject in places else _folders_with_scans(folder)
    if subject not in places:
        if (folder / subject).is_dir():
            raise UserError(f"no scans in {folder / subject}; wanted {_WANTED}; see data/README.md")
        known = f"; wanted one of {', '.join(list(places)[:8])}" if places else f"; wanted {_WANTED}"
        raise UserError(f"no subject '{subject}' in {folder}{nearest(subject, places) or known}")
    place = places[subject]
    folders = [path for path in subfolders(place) if frame_files(path)] or [place]
    if folders == [place]:
        _check_not_rigged(place)
    names = folder_names(path.name if path != place else subject for path in folders)
    return place, [ScanFolder(name, path, tuple(frame_files(path))) for name, path in zip(names, folders, strict=True)]


def _folders_with_scans(folder: Path) -> dict[str, Path]:
    """Return the folders in a folder that have scans, or folders with scans, by name."""
    inside = subfolders(folder)
    return {path.name: path for path in inside if frame_files(path) or any(map(frame_files, subfolders(path)))}


def _check_not_rigged(place: Path) -> None:
    """Raise UserError if a folder has a file with a skin, which brings its skeleton and motion."""
    for path in rigged_files(place)[:1]:
        try:
            read_rigged_files([path])
        except UserError:  # a mesh without a skin
            return
        raise UserError(f"{path} has a skin, a skeleton and its own motion, so nothing is fitted; give it to snarf preprocess")


def _is_inside_out(points: Array, normals: Array) -> bool:
    """Return whether the normals point inward: the points, which are spread by area, enclose a negative volume."""
    lower, upper = points.min(0), points.max(0)
    return bool(((points - (lower + upper) / 2) * normals).sum() < 0)
