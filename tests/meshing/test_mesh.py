from __future__ import annotations

import numpy as np
import pytest
import trimesh

from snarfcli.meshing.mesh import Mesh, vertex_normals


def test_normals_of_a_sphere_point_outward():
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = vertex_normals(ball.vertices, ball.faces)
    np.testing.assert_allclose(normals, ball.vertices, atol=0.02)  # 642 vertices: facets turn by about 8 degrees
    assert Mesh(ball.vertices, ball.faces).with_normals().normals.dtype == np.float32


def test_a_vertex_without_faces_has_a_unit_normal():
    normals = vertex_normals(np.eye(4, 3), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"vertices": np.zeros((3, 2))}, r"vertices: wanted shape \[n, 3\]"),
        ({"faces": np.array([[0, 1, 3]])}, "faces: wanted indices of 3 vertices, got 3"),
        ({"colors": np.zeros((2, 3))}, r"colors: wanted shape \[3, 3\], got \[2, 3\]"),
        ({"normals": np.zeros((3, 4))}, r"normals: wanted shape \[3, 3\], got \[3, 4\]"),
    ],
)
def test_wrong_arrays_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Mesh(**({"vertices": np.eye(3), "faces": np.array([[0, 1, 2]])} | arguments))
