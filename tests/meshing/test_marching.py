from __future__ import annotations

import numpy as np
import pytest
import trimesh

from snarfcli.meshing.marching import march


@pytest.mark.parametrize("zeros", [0.0, 0.2], ids=["noise", "noise and zeros"])
def test_any_signs_give_closed_manifolds(zeros):
    rng = np.random.default_rng(0)
    values = rng.standard_normal((45, 21, 30)).astype(np.float32)  # longer than a slab along the first axis
    values[rng.random(values.shape) < zeros] = 0.0
    values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = -1
    crossings = march(values)
    vertices = crossings.node_a.astype(float)
    vertices[np.arange(len(vertices)), crossings.axis] += 0.5
    solid = trimesh.Trimesh(vertices, crossings.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert ((crossings.value_a > 0) != (crossings.value_b > 0)).all()


def test_one_node_is_an_octahedron():
    values = -np.ones((3, 3, 3), np.float32)
    values[1, 1, 1] = 3.0
    crossings = march(values)
    assert len(crossings.faces) == 8
    assert len(crossings.axis) == 6
    assert sorted(np.bincount(crossings.axis)) == [2, 2, 2]
    assert set(np.stack([crossings.value_a, crossings.value_b]).ravel()) == {3.0, -1.0}
