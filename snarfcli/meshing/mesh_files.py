"""Meshes as PLY and OBJ files."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from snarfcli.errors import UserError
from snarfcli.files import atomic_path
from snarfcli.formats.plain_meshes import parse_obj, text_lines
from snarfcli.formats.ply import parse_ply
from snarfcli.formats.ply_header import read_ply_header
from snarfcli.meshing.mesh import Mesh
from snarfcli.texts import one_line

__all__ = ["MESH_WRITERS", "read_mesh", "write_mesh", "write_obj", "write_ply"]

_MAX_BYTES = 2**28


def write_ply(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh with its normals and colours as binary little-endian PLY.

    The file is whole or absent; a power cut soon afterwards may take it.
    """
    columns: list[tuple[str, str, str, np.ndarray]] = []  # PLY type, name, numpy type, values
    groups = [("float", "<f4", ("x", "y", "z"), mesh.vertices), ("float", "<f4", ("nx", "ny", "nz"), mesh.normals)]
    groups.append(("uchar", "u1", ("red", "green", "blue"), mesh.colors))
    for ply_type, numpy_type, names, values in groups:
        if values is not None:
            columns += [(ply_type, name, numpy_type, values[:, i]) for i, name in enumerate(names)]
    rows = np.empty(len(mesh.vertices), dtype=[(name, numpy_type) for _, name, numpy_type, _ in columns])
    for _, name, _, values in columns:
        rows[name] = values
    triangles = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    triangles["count"] = 3
    triangles["index"] = mesh.faces
    header = ["ply", "format binary_little_endian 1.0", "comment made by snarf, metres, y up"]
    header += [f"element vertex {len(rows)}", *(f"property {kind} {name}" for kind, name, _, _ in columns)]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    with atomic_path(path, flush_name=False) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(rows.tobytes())
        file.write(triangles.tobytes())


def write_obj(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as OBJ. The file is whole or absent; a power cut soon afterwards may take it.

    Colours follow the coordinates of a vertex as three numbers from 0 to 1, which Blender, MeshLab and trimesh read.
    """
    vertices = mesh.vertices.astype(np.float64)
    text = io.StringIO()
    text.write("# made by snarf, metres, y up\n")
    if mesh.colors is None:
        np.savetxt(text, vertices, fmt="v %.7g %.7g %.7g")
    else:
        np.savetxt(text, np.hstack([vertices, mesh.colors / 255.0]), fmt="v %.7g %.7g %.7g %.4f %.4f %.4f")
    faces = mesh.faces.astype(np.int64) + 1
    if mesh.normals is None:
        np.savetxt(text, faces, fmt="f %d %d %d")
    else:
        np.savetxt(text, mesh.normals, fmt="vn %.5f %.5f %.5f")
        np.savetxt(text, faces.repeat(2, axis=1), fmt="f %d//%d %d//%d %d//%d")
    with atomic_path(path, flush_name=False) as temporary:
        temporary.write_bytes(text.getvalue().encode())


MESH_WRITERS: dict[str, Callable[[str | Path, Mesh], None]] = {"ply": write_ply, "obj": write_obj}
"""Writers of mesh files by suffix."""


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh in the format of the suffix of `path`.

    Raises:
        UserError: the format is unknown.
    """
    suffix = Path(path).suffix.lower().lstrip(".")
    if suffix not in MESH_WRITERS:
        endings = " or ".join(f".{known}" for known in MESH_WRITERS)
        raise UserError(f"mesh {path}: wanted a name ending in {endings}, got {Path(path).name!r}")
    MESH_WRITERS[suffix](path, mesh)


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh in one of the formats of `write_mesh` with its colours; vertices are neither merged nor reordered.

    `formats.surfaces.read_surface` reads more formats.

    Raises:
        UserError: the file is missing, of another format, too large or damaged.
        OSError, MemoryError: the system cannot read it.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"no mesh at {path}")
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in _READERS or not path.is_file():
        raise UserError(f"mesh {path}: wanted a file ending in {' or '.join(f'.{known}' for known in _READERS)}")
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(f"mesh {path} is larger than {_MAX_BYTES >> 20} MiB; extract it at a lower resolution")
    content = path.read_bytes()
    try:
        with np.errstate(all="ignore"):  # infinite and NaN are rejected below
            mesh = _READERS[suffix](content)
        if not np.isfinite(mesh.vertices).all():
            raise ValueError("it has NaN or infinity among its vertices")
    except (ValueError, OverflowError) as error:
        raise UserError(f"mesh {path} cannot be read ({one_line(error, 200)}); make it again") from None
    return mesh


def _read_ply(content: bytes) -> Mesh:
    """Return the mesh in a PLY file, with colours from its table of vertices; ValueError if it is damaged."""
    vertices, faces = parse_ply(content)
    header, colors = read_ply_header(content), None
    first = header.elements[0] if header.elements else None
    if header.order and first is not None and first.name == "vertex" and not first.has_lists:
        names = [one.name for one in first.properties]
        dtype = np.dtype([(str(number), header.order + one.code) for number, one in enumerate(first.properties)])
        columns = [names.index(name) for name in ("red", "green", "blue") if name in names]
        if len(columns) == 3 and all(first.properties[column].code == "B" for column in columns):
            table = np.frombuffer(content, dtype, first.count, header.starts[0])
            colors = np.stack([table[str(column)] for column in columns], 1)
    return Mesh(vertices, faces, colors=colors)


def _read_obj(content: bytes) -> Mesh:
    """Return the mesh in an OBJ file, with colours that follow the coordinates; ValueError if it is damaged."""
    vertices, faces = parse_obj(content)
    texts = [words[4:7] for words in text_lines(content) if words[0] == b"v" and len(words) == 7]
    colors = None
    if vertices.size and len(texts) == len(vertices):
        shares = np.array([[float(word) for word in words] for words in texts])
        colors = np.rint(255 * np.clip(np.nan_to_num(shares), 0, 1)).astype(np.uint8)
    return Mesh(vertices, faces, colors=colors)


_READERS: dict[str, Callable[[bytes], Mesh]] = {"ply": _read_ply, "obj": _read_obj}
