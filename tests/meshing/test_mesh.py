from __future__ import annotations

import numpy as np
import pytest
import trimesh

from snarfcli.meshing.mesh import Mesh, face_components, keep_components, vertex_normals


def test_normals_of_a_sphere_point_outward():
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = vertex_normals(ball.vertices, ball.faces)
    np.testing.assert_allclose(normals, ball.vertices, atol=0.02)  # 642 vertices: facets turn by about 8 degrees
    assert Mesh(ball.vertices, ball.faces).with_normals().normals.dtype == np.float32


def test_a_vertex_without_faces_has_a_unit_normal():
    normals = vertex_normals(np.eye(4, 3), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-6)


def test_components_are_numbered_by_size():
    small, large = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.icosphere(subdivisions=2)
    vertices = np.concatenate([small.vertices, large.vertices + 5])
    faces = np.concatenate([small.faces, large.faces + len(small.vertices)])
    labels = face_components(faces, len(vertices))
    np.testing.assert_array_equal(labels, np.repeat([1, 0], [len(small.faces), len(large.faces)]))
    kept_vertices, kept_faces, found, kept = keep_components(vertices, faces, 0.5)
    assert (found, kept) == (2, 1)
    np.testing.assert_array_equal(kept_vertices[kept_faces], large.vertices[large.faces] + 5)
    assert face_components(np.zeros((0, 3), int), 0).shape == (0,)


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
