from __future__ import annotations

import importlib.util
import sys

import igl
import numpy as np
import pytest
import trimesh

from snarfcli.bodies import builtin_body
from snarfcli.export.decimate import decimate
from snarfcli.meshing.mesh import Mesh


@pytest.fixture(params=["meshlab", "libigl"])
def program(request, monkeypatch) -> str:
    """With and without MeshLab."""
    if request.param == "libigl":
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        monkeypatch.setitem(sys.modules, "pymeshlab", None)  # an import would fail
    else:
        pytest.importorskip("pymeshlab")
    return request.param


def ball(subdivisions: int = 3) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions, 0.5)
    return Mesh(solid.vertices, solid.faces)


@pytest.mark.usefixtures("program")
def test_a_budget_is_kept_and_the_shape_too():
    mesh = decimate(ball(), 200)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert 150 < len(mesh.faces) <= 200
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * np.pi / 8, rel=0.05)
    angles = np.degrees(solid.face_angles)
    assert angles.min() > 10  # no slivers, on which shading breaks


def test_enough_triangles_are_left_alone():
    mesh = ball(2)
    assert decimate(mesh, 320) is mesh
    assert len(mesh.faces) == 320


@pytest.mark.usefixtures("program")
def test_so_few_that_it_tears_are_refused():
    solids = [trimesh.creation.icosphere(1, 0.1).apply_translation((x, 0, 0)) for x in range(5)]
    joined = trimesh.util.concatenate(solids)
    with pytest.raises(ValueError, match=r"triangles: wanted at least \d+ for this surface, got 10; fewer would tear it"):
        decimate(Mesh(joined.vertices, joined.faces), 10)


def test_both_programs_keep_the_surface_of_a_body(program, caplog):
    body = builtin_body()
    whole = trimesh.Trimesh(body.v_template.numpy(), body.faces.numpy(), process=False)
    with caplog.at_level("INFO", "snarfcli"):
        mesh = decimate(Mesh(whole.vertices, whole.faces), 3000)
    assert 2990 <= len(mesh.faces) <= 3000
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.euler_number == whole.euler_number
    distance, _, _ = igl.point_mesh_squared_distance(whole.vertices, solid.vertices, solid.faces.astype(np.int64))
    assert np.sqrt(distance).mean() < 1e-3  # measured: 0.85 mm with MeshLab, 0.62 mm with libigl
    assert ("since pymeshlab is not installed" in caplog.text) == (program == "libigl")
