"""Meshes as PLY and OBJ files."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.errors import UserError
from snarfcli.files import atomic_path
from snarfcli.meshing.mesh import Mesh

__all__ = ["MESH_WRITERS", "read_mesh", "write_mesh", "write_obj", "write_ply"]


def write_ply(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh with its normals and colours as binary little-endian PLY. The file is whole or absent."""
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
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(rows.tobytes())
        file.write(triangles.tobytes())


def write_obj(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as OBJ. The file is whole or absent.

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
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue())


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
    """Read a triangle mesh with its colours; vertices are neither merged nor reordered.

    Raises:
        UserError: the file is missing or is not a mesh.
    """
    import trimesh  # here: loading it takes a second, and writing does not need it

    path = Path(path)
    if not path.is_file():
        raise UserError(f"no mesh at {path}")
    try:
        loaded = trimesh.load_mesh(path, process=False, maintain_order=True)
        visual: Any = loaded.visual  # its attributes depend on its kind
        colors = visual.vertex_colors[:, :3] if visual.kind == "vertex" else None
        return Mesh(loaded.vertices, loaded.faces, colors=colors)
    except (ValueError, KeyError, IndexError, AttributeError, NotImplementedError) as error:
        raise UserError(f"mesh {path} cannot be read ({error}); make it again") from None
