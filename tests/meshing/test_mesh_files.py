from __future__ import annotations

import numpy as np
import pymeshlab
import pytest
import trimesh

from snarfcli.errors import UserError
from snarfcli.meshing.colors import bone_colors, weights_to_colors
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.mesh_files import read_mesh, write_mesh, write_obj, write_ply


def ball(colors: bool, normals: bool) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    rng = np.random.default_rng(0)
    mesh = Mesh(
        np.add(solid.vertices, [0.1, -0.2, 3.0]),
        solid.faces,
        colors=rng.integers(0, 256, solid.vertices.shape) if colors else None,
    )
    return mesh.with_normals() if normals else mesh


@pytest.mark.parametrize("suffix", ["ply", "obj"])
@pytest.mark.parametrize("colors", [False, True], ids=["plain", "colours"])
@pytest.mark.parametrize("normals", [False, True], ids=["flat", "normals"])
def test_independent_readers_read_back(tmp_path, suffix, colors, normals):
    mesh = ball(colors, normals)
    path = tmp_path / "folder" / f"mesh.{suffix}"
    write_mesh(path, mesh)

    loaded = trimesh.load(path, process=False, maintain_order=True)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, atol=1e-6)  # 7 digits of 3 m
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    assert loaded.is_watertight
    assert loaded.volume > 0
    assert (loaded.visual.kind == "vertex") == colors
    if colors:
        assert np.abs(loaded.visual.vertex_colors[:, :3].astype(int) - mesh.colors).max() <= 1
    if normals:
        np.testing.assert_allclose(loaded.vertex_normals, mesh.normals, atol=1e-4)

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    seen = meshes.current_mesh()
    np.testing.assert_allclose(seen.vertex_matrix(), mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(seen.face_matrix(), mesh.faces)
    if colors:
        assert np.abs(seen.vertex_color_matrix()[:, :3] * 255 - mesh.colors).max() <= 1.01

    again = read_mesh(path)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-6)
    assert (again.colors is not None) == colors
    if colors:
        assert np.abs(again.colors.astype(int) - mesh.colors).max() <= (suffix == "obj")  # written with four decimals


def test_nothing_half_written(tmp_path, monkeypatch):
    monkeypatch.setattr(np, "savetxt", lambda *_, **__: (_ for _ in ()).throw(OSError("no space")))
    with pytest.raises(OSError, match="no space"):
        write_obj(tmp_path / "mesh.obj", ball(True, True))
    broken = ball(False, False)
    object.__setattr__(broken, "faces", np.zeros((2, 5)))
    with pytest.raises(ValueError, match="could not broadcast"):
        write_ply(tmp_path / "mesh.ply", broken)
    assert not list(tmp_path.iterdir())


def test_bone_colours_are_distinct_and_stable():
    colors = bone_colors(24)
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=2) + np.eye(24)
    assert apart.min() > 0.2
    np.testing.assert_array_equal(bone_colors(55)[:24], colors)
    assert len(np.unique(bone_colors(55).round(6), axis=0)) == 55
    one_hot = weights_to_colors(np.eye(24, dtype=np.float32))
    np.testing.assert_array_equal(one_hot, np.rint(colors * 255))
    assert weights_to_colors(np.full((3, 24), 1 / 24)).dtype == np.uint8


def test_messages(tmp_path):
    with pytest.raises(UserError, match=r"wanted a name ending in \.ply or \.obj"):
        write_mesh(tmp_path / "mesh.stl", ball(False, False))
    with pytest.raises(UserError, match="no mesh at"):
        read_mesh(tmp_path / "mesh.ply")
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproper")
    with pytest.raises(UserError, match="cannot be read"):
        read_mesh(tmp_path / "broken.ply")
    (tmp_path / "far.obj").write_text("v 0 0 0\nv 1e300 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(UserError, match="NaN or infinity among its vertices"):
        read_mesh(tmp_path / "far.obj")
    (tmp_path / "mesh.stl").touch()
    with pytest.raises(UserError, match=r"wanted a file ending in \.ply or \.obj"):
        read_mesh(tmp_path / "mesh.stl")
