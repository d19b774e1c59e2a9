from __future__ import annotations

import numpy as np
import pytest
import trimesh

from snarfcli.export.decimate import decimate
from snarfcli.meshing.mesh import Mesh


def ball(subdivisions: int = 3) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions, 0.5)
    return Mesh(solid.vertices, solid.faces)


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


def test_so_few_that_it_tears_are_refused():
    solids = [trimesh.creation.icosphere(1, 0.1).apply_translation((x, 0, 0)) for x in range(5)]
    joined = trimesh.util.concatenate(solids)
    with pytest.raises(ValueError, match=r"triangles: wanted at least \d+ for this surface, got 10; fewer would tear it"):
        decimate(Mesh(joined.vertices, joined.faces), 10)
