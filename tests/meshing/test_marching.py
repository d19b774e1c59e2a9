from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes

from snarfcli.meshing.lattice import Lattice
from snarfcli.meshing.marching import Crossings, march
from snarfcli.meshing.marching_table import EDGES, triangles_of_signs


def marched(values: np.ndarray) -> Crossings:
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, 1, values.shape)
    return march(lattice, torch.from_numpy(values > 0), torch.from_numpy(values).reshape(-1))


def middles(crossings: Crossings) -> np.ndarray:
    vertices = crossings.node_a.numpy().astype(float)
    vertices[np.arange(len(vertices)), crossings.axis.numpy()] += 0.5
    return vertices


def noise(zeros: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    values = rng.standard_normal((45, 21, 30)).astype(np.float32)
    values[rng.random(values.shape) < zeros] = 0.0
    values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = -1
    return values


@pytest.mark.parametrize("zeros", [0.0, 0.2], ids=["noise", "noise and zeros"])
def test_any_signs_give_closed_manifolds(zeros):
    crossings = marched(noise(zeros))
    vertices = middles(crossings)
    solid = trimesh.Trimesh(vertices, crossings.faces.numpy(), process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert ((crossings.value_a > 0) != (crossings.value_b > 0)).all()


def oriented(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return triangles [F, 9] as twice their corners, in order; each begins with its first corner by that order."""
    corners = np.rint(2 * vertices).astype(int)[faces]
    rank = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    turned = (rank.argmin(1)[:, None] + np.arange(3)) % 3
    return np.unique(np.take_along_axis(corners, turned[:, :, None], 1).reshape(-1, 9), axis=0)


def test_triangles_are_those_of_scikit_image():
    values = noise(0.1)
    crossings = marched(values)
    signs = np.where(values > 0, np.float32(1), np.float32(-1))
    wanted, faces, _, _ = marching_cubes(signs, 0.0, method="lorensen", gradient_direction="ascent")
    np.testing.assert_array_equal(oriented(middles(crossings), crossings.faces.numpy()), oriented(wanted, faces))
    assert len(crossings.faces) == len(faces)
    assert set(np.unique(crossings.faces)) == set(range(len(crossings.axis)))


def test_all_signs_have_triangles_on_the_edges_that_they_cross():
    for signs, triangles in enumerate(triangles_of_signs()):
        crossed = {
            edge
            for edge, (corner, axis) in enumerate(EDGES)
            if (signs >> corner & 1) != (signs >> (corner + (4, 2, 1)[axis]) & 1)
        }
        assert set(triangles[triangles >= 0].tolist()) == crossed


def test_one_node_is_an_octahedron():
    values = -np.ones((3, 3, 3), np.float32)
    values[1, 1, 1] = 3.0
    crossings = marched(values)
    assert len(crossings.faces) == 8
    assert len(crossings.axis) == 6
    assert sorted(np.bincount(crossings.axis)) == [2, 2, 2]
    assert set(np.stack([crossings.value_a, crossings.value_b]).ravel()) == {3.0, -1.0}


def test_a_node_closed_at_the_border_counts_as_outside():
    values = torch.tensor([-1.0, -1, -1, 2, 1, -1, -1, -1, -1]).repeat(3).view(3, 3, 3)
    inside = torch.zeros(3, 3, 3, dtype=torch.bool)
    inside[1, 1, 1] = True
    crossings = march(Lattice((0.0, 0.0, 0.0), 1.0, 1, (3, 3, 3)), inside, values.reshape(-1))
    assert len(crossings.axis) == 6
    below = (crossings.axis == 2) & (crossings.node_a[:, 2] == 0)
    assert crossings.value_a[below].tolist() == [-2.0]
    assert crossings.value_b[below].tolist() == [1.0]
