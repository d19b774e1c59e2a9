"""Read the surface in a mesh file of a common format, and list such files in a folder."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError, raise_system_error
from snarfcli.formats.gltf import read_gltf_surface
from snarfcli.formats.off import parse_off
from snarfcli.formats.plain_meshes import MAX_FACES, parse_obj, parse_stl
from snarfcli.formats.ply import parse_ply
from snarfcli.texts import one_line

__all__ = ["SURFACE_SUFFIXES", "checked_surface", "list_files", "list_surfaces", "read_mesh_bytes", "read_surface"]

SURFACE_SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""File suffixes that `read_surface` accepts, in lower case."""

_PARSERS = {".obj": parse_obj, ".off": parse_off, ".ply": parse_ply, ".stl": parse_stl}
_TEXT_PLY = re.compile(rb"\A(?:\xef\xbb\xbf)?ply\s(?:.*[\r\n])?\s*format\s+ascii", re.DOTALL)
_MAX_BYTES = 64 * 2**20
# A word of text takes up to 60 bytes after splitting. PLY files are split as a whole, the others line by line.
_MAX_WORDS = 8_000_000


def list_surfaces(folder: str | Path) -> list[Path]:
    """Return the mesh files directly inside a folder, `frame_2` before `frame_10`; hidden files are left out.

    Raises:
        UserError: the folder does not exist or cannot be opened.
    """
    return list_files(folder, SURFACE_SUFFIXES)


def list_files(folder: str | Path, suffixes: Collection[str]) -> list[Path]:
    """Return the files with some suffixes (lower case) directly inside a folder, sorted and with errors as `list_surfaces`."""
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"no folder with meshes at {folder}")
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    except OSError as error:
        raise UserError(f"folder {folder} cannot be opened ({error.strerror or error})") from None
    return sorted((path for path in found if path.is_file()), key=_natural)


def _natural(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key that compares numbers in names by value."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    # Numbers stay text, compared by length first: a name may hold more digits than Python converts to an integer.
    return [(len(p.lstrip("0")), p.lstrip("0")) if i % 2 else (-1, p) for i, p in enumerate(parts)], path.name


def read_surface(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read the triangles of a mesh file in one of the formats of `SURFACE_SUFFIXES`.

    Polygons are cut into fans of triangles. All objects or solids of a file form one surface. The transforms of a glTF scene
    are applied, and its skins take the pose of the nodes. Materials and textures are ignored; no other file is opened except
    the buffers of a `.gltf`. All vertices are kept, in the order of the file: those of an OBJ file are its `v` lines,
    independent of texture coordinates. Triangles that name a vertex twice are dropped.

    If the stored surface is open, vertices with bitwise equal positions are merged into the first of them. This closes surfaces
    that were only split along seams. STL and glTF files, whose formats require such splits, are always merged. A closed surface
    of another format is not changed, so meshes of one topology keep it.

    Args:
        path: the file.

    Returns:
        vertices: [V, 3], float64, units and axes of the file.
        faces: [F, 3], int64, F > 0.

    Raises:
        UserError: the file is missing, damaged, too large, of an unknown format, or has no triangles (a point cloud).
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SURFACE_SUFFIXES:
        raise UserError(
            f"mesh {path}: wanted a file ending in {', '.join(SURFACE_SUFFIXES)}, got {suffix or 'no ending'!r:.40}"
        )
    if suffix in (".glb", ".gltf"):
        vertices, faces = read_gltf_surface(path)
    else:
        content = read_mesh_bytes(path)
        try:
            with np.errstate(invalid="ignore"):  # NaN is rejected below
                vertices, faces = _PARSERS[suffix](content)
        except (ValueError, OverflowError, MemoryError) as error:
            raise_system_error(error, path)
            raise UserError(f"mesh {path} cannot be read ({one_line(error, 200)}); copy it again or export it again") from None
    return checked_surface(path, vertices, faces)


def checked_surface(
    path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the surface of a file that was parsed, as `read_surface` describes it, or raise UserError as it does.

    Args:
        path: the file.
        vertices: [V, 3].
        faces: [F, 3], not yet checked.
    """
    suffix = path.suffix.lower()
    if not len(faces):
        raise UserError(f"mesh {path} has no triangles (a point cloud is not a surface); give a mesh with faces")
    if len(faces) > MAX_FACES:
        raise UserError(f"mesh {path}: wanted at most {MAX_FACES} triangles, got {len(faces)}; simplify it")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"mesh {path} has faces that refer to vertices beyond its {len(vertices)}; export it again")
    if not np.isfinite(vertices).all():
        raise UserError(f"mesh {path} has NaN or infinity among its vertices; repair it or export it again")
    faces = _with_area(faces)
    if suffix == ".stl" or (suffix in _PARSERS and _is_open(faces, len(vertices))):
        vertices, faces = _merged(vertices, faces, keep_all=suffix != ".stl")
    if not len(faces):
        raise UserError(f"mesh {path} has only triangles of zero area; give a mesh with a surface")
    return vertices, faces


def read_mesh_bytes(path: Path) -> bytes:
    """Return the bytes of a file of a surface or of points.

    Raises:
        UserError: it is missing, cannot be opened, is too large, or is a PLY file with too many words of text.
    """
    try:
        if not path.exists():
            raise UserError(f"no mesh at {path}")
        if not path.is_file():  # reading a pipe would block forever
            raise UserError(f"mesh {path} is not a file; give one of {', '.join(SURFACE_SUFFIXES)}")
        if path.stat().st_size > _MAX_BYTES:
            raise UserError(f"mesh {path} is larger than {_MAX_BYTES // 2**20} MiB; simplify it, or save it as .glb")
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"mesh {path} cannot be opened ({error.strerror or error})") from None
    if _TEXT_PLY.search(content, 0, 2**16):
        values = np.frombuffer(content, np.uint8)
        if sum(np.count_nonzero(np.diff(piece <= 32)) for piece in np.array_split(values, 32)) > 2 * _MAX_WORDS:
            raise UserError(f"mesh {path} has over {_MAX_WORDS} words of text; simplify it, or save it as binary")
    return content


def _with_area(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles that name three different vertices."""
    return faces[(faces != np.roll(faces, 1, 1)).all(1)]


def _is_open(faces: NDArray[np.int64], num_vertices: int) -> bool:
    """Return whether some edge belongs to only one triangle."""
    edges = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    _, counts = np.unique(edges.min(1) * num_vertices + edges.max(1), return_counts=True)
    return bool((counts == 1).any())


def _merged(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], *, keep_all: bool
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Merge vertices of equal position into the first of them, and drop the triangles that become degenerate.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        keep_all: keep vertices that no triangle uses; merged vertices are removed in any case.
    """
    rows = np.ascontiguousarray(vertices + 0.0)  # turns -0.0 into 0.0
    keys = rows.view(np.dtype((np.void, 24)))[:, 0]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    target = first[inverse.reshape(-1)]
    is_kept = target == np.arange(len(vertices))
    faces = _with_area(target[faces])
    if not keep_all:
        is_kept &= np.isin(np.arange(len(vertices)), faces)
    return vertices[is_kept], (np.cumsum(is_kept) - 1)[faces]
