"""Read the points of a scan from a file, or a frame that may be a surface or points, and list the frames in a folder."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.array_files import read_npy, read_npz
from snarfcli.errors import UserError, raise_system_error
from snarfcli.formats.off import parse_off
from snarfcli.formats.plain_meshes import Surface, parse_obj
from snarfcli.formats.ply import read_ply
from snarfcli.formats.point_tables import parse_obj_points, parse_point_text, points_of_table
from snarfcli.formats.surfaces import (
    SURFACE_SUFFIXES,
    checked_surface,
    list_files,
    list_surfaces,
    read_mesh_bytes,
    read_surface,
)
from snarfcli.texts import one_line

__all__ = ["POINT_SUFFIXES", "PointFile", "list_frames", "read_frame", "read_points"]

POINT_SUFFIXES = (".xyz", ".npy", ".npz", ".csv", ".txt")
"""File suffixes of points that no surface has, in lower case. Of those of surfaces, .ply, .obj and .off may hold points."""

_TEXT_SUFFIXES = (".csv", ".txt")
_POINTS_OR_SURFACE = (".ply", ".obj", ".off")
_MAX_POINTS = 2_000_000
_MAX_ARRAY_BYTES = 2**28
_POINT_NAMES = ("points", "vertices", "xyz", "positions")
_NORMAL_NAMES = ("normals", "normal")
_DIRECTION = np.array([0.5377, 0.3141, 0.7825])  # along which different points hardly ever have equal coordinates


@dataclass(frozen=True, eq=False)
class PointFile:
    """The points of a file, in its units and axes."""

    points: NDArray[np.float64]
    """[P, 3], P > 0, finite, all different, in the order of the file."""
    normals: NDArray[np.float64] | None
    """[P, 3], as in the file, of any length and side; None if it has none."""


def list_frames(folder: str | Path, leave_out: Collection[str] = ()) -> list[Path]:
    """Return the files of frames directly inside a folder, `frame_2` before `frame_10`; hidden files are left out.

    They are those with a suffix of surfaces. Without any, they are those with the first suffix of points that there is, but of
    text files (.csv, .txt) only those with a digit in their names, since others are notes.

    Args:
        folder: the folder.
        leave_out: names of files that are no frames, such as poses.npz.

    Raises:
        UserError: the folder does not exist or cannot be opened.
    """
    surfaces = list_surfaces(folder)
    if surfaces:
        return surfaces
    files = [path for path in list_files(folder, POINT_SUFFIXES) if path.name not in leave_out and _may_be_frame(path)]
    suffixes = {path.suffix.lower() for path in files}
    chosen = next((suffix for suffix in POINT_SUFFIXES if suffix in suffixes), None)
    return [path for path in files if path.suffix.lower() == chosen]


def _may_be_frame(path: Path) -> bool:
    return path.suffix.lower() not in _TEXT_SUFFIXES or any(letter.isdigit() for letter in path.stem)


def read_points(path: str | Path) -> PointFile:
    """Read the points of a file: a PLY, OBJ or OFF file, of which faces are ignored, text, or an array.

    Normals are nx, ny and nz of a PLY file, as many `vn` as `v` lines of an OBJ file, three columns of unit length in a text
    or an array `.npy`, and an array `normals` in an `.npz`, whose points are called points, vertices, xyz or positions.
    Of points that occur several times, such as the corners of separate triangles, the first is kept.

    Raises:
        UserError: the file is missing, damaged, too large, of an unknown format, or has no points.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (*POINT_SUFFIXES, *_POINTS_OR_SURFACE):
        wanted = ", ".join((*POINT_SUFFIXES, *_POINTS_OR_SURFACE))
        raise UserError(f"points {path}: wanted a file ending in {wanted}, got {suffix or 'no ending'!r:.40}")
    points, normals, _ = _read(path, suffix)
    return _checked_points(path, points, normals)


def read_frame(path: str | Path) -> Surface | PointFile:
    """Read a frame: its surface as `read_surface` does, or if the file has no triangles, its points as `read_points` does.

    Raises:
        UserError: as these functions.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in SURFACE_SUFFIXES and suffix not in _POINTS_OR_SURFACE:
        return read_surface(path)
    if suffix in POINT_SUFFIXES:
        return read_points(path)
    if suffix not in SURFACE_SUFFIXES:
        wanted = ", ".join((*SURFACE_SUFFIXES, *POINT_SUFFIXES))
        raise UserError(f"frame {path}: wanted a file ending in {wanted}, got {suffix or 'no ending'!r:.40}")
    points, normals, faces = _read(path, suffix)
    return checked_surface(path, points, faces) if len(faces) else _checked_points(path, points, normals)


def _read(path: Path, suffix: str) -> tuple[NDArray, NDArray | None, NDArray[np.int64]]:
    """Return points [P, 3], normals [P, 3] or None, and faces [F, 3] of a file, none of which is checked."""
    no_faces = np.zeros((0, 3), np.int64)
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # NaN is rejected later
            if suffix in (".npy", ".npz"):
                return *_read_arrays(path, suffix), no_faces
            content = read_mesh_bytes(path)
            if suffix == ".ply":
                ply = read_ply(content)
                return ply.vertices, ply.normals, ply.faces
            if suffix == ".off":
                vertices, faces = parse_off(content)
                return vertices, None, faces
            if suffix == ".obj":
                vertices, faces = parse_obj(content)
                return (vertices, None, faces) if len(faces) else (*parse_obj_points(content), faces)
            return *parse_point_text(content), no_faces
    except UserError:
        raise
    except (ValueError, OverflowError, MemoryError) as error:
        raise_system_error(error, path)
        raise UserError(f"{path} cannot be read ({one_line(error, 200)}); copy it again or export it again") from None


def _read_arrays(path: Path, suffix: str) -> tuple[NDArray, NDArray | None]:
    """Return the points and normals of an array file."""
    if suffix == ".npy":
        return points_of_table(_numbers(read_npy(path, "points", max_bytes=_MAX_ARRAY_BYTES)))
    arrays = read_npz(path, "points", only=(*_POINT_NAMES, *_NORMAL_NAMES), max_bytes=_MAX_ARRAY_BYTES)
    points, normals = (
        next((arrays[name] for name in names if name in arrays), None) for names in (_POINT_NAMES, _NORMAL_NAMES)
    )
    if points is None:
        raise ValueError(f"wanted an array called {', '.join(_POINT_NAMES[:-1])} or {_POINT_NAMES[-1]}")
    if normals is None:
        return points_of_table(_numbers(points))
    if points.ndim != 2 or points.shape[1] != 3 or normals.shape != points.shape:
        raise ValueError(f"wanted points and normals [P, 3], got {list(points.shape)[:6]} and {list(normals.shape)[:6]}")
    return _numbers(points), _numbers(normals)


def _numbers(values: NDArray) -> NDArray[np.float64]:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"wanted an array of numbers, got type {str(values.dtype)[:40]}")
    if values.size > 16 * _MAX_POINTS:
        raise ValueError(f"wanted at most {_MAX_POINTS} points, got {values.size} numbers")
    return values.astype(np.float64)


def _checked_points(path: Path, points: NDArray, normals: NDArray | None) -> PointFile:
    if not len(points):
        raise UserError(f"{path} has no points; export it again")
    if len(points) > _MAX_POINTS:
        raise UserError(f"{path}: wanted at most {_MAX_POINTS} points, got {len(points)}; reduce them")
    bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
    if bad:
        raise UserError(f"{path}: {bad} of its {len(points)} points are NaN or infinite; remove them or export it again")
    kept = _first_of_equal(points)
    return PointFile(points[kept], None if normals is None else normals[kept])


def _first_of_equal(points: NDArray[np.float64]) -> slice | NDArray[np.intp]:
    """Return which points [P, 3] to keep, so that each place occurs once."""
    with np.errstate(all="ignore"):
        along = np.diff(np.sort(points @ _DIRECTION))
    if along.all():  # faster than comparing all coordinates, which few files need
        return slice(None)
    return np.sort(np.unique(points, axis=0, return_index=True)[1])
