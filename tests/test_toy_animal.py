from __future__ import annotations

import numpy as np
import pytest
import trimesh
from toy_animal import ANIMAL_CLIPS, HELD_OUT_CLIP, animal_motion, make_animal
from toy_animal_files import write_animal_bvh, write_animal_meshes

from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.surfaces import list_surfaces, read_surface


@pytest.mark.parametrize(("spacing", "vertices"), [(0.0225, (3000, 6000)), (0.08, (200, 400))])
def test_animal_is_one_closed_surface(spacing, vertices):
    animal = make_animal(spacing)
    mesh = trimesh.Trimesh(animal.vertices, animal.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert vertices[0] < len(animal.vertices) < vertices[1]
    assert len(animal.names) == 19
    np.testing.assert_allclose(animal.weights.sum(1), 1, atol=1e-12)
    assert ((animal.weights > 0).sum(1) <= 4).all()
    assert animal.vertices[:, 1].min() == pytest.approx(0, abs=0.03)


def test_clips_show_different_poses():
    poses = {name: animal_motion(name).poses for name in ANIMAL_CLIPS}
    for frame in poses[HELD_OUT_CLIP][24:]:
        for name in set(ANIMAL_CLIPS) - {HELD_OUT_CLIP}:
            assert np.abs(poses[name] - frame).max((1, 2)).min() > 0.5  # radians, of some joint


def test_bvh_and_meshes_say_the_same(tmp_path):
    animal, motion = make_animal(0.08), animal_motion("sit", 12)
    write_animal_bvh(tmp_path / "sit.bvh", animal, motion)
    rig = read_bvh(tmp_path / "sit.bvh")
    columns = [rig.names.index(name) for name in animal.names]
    places = rig.clips[0].world_from_joint[:, columns]
    np.testing.assert_allclose(places, animal.place(motion.poses, motion.translation), atol=1e-5)
    write_animal_meshes(tmp_path / "meshes", animal, [motion], ".ply")
    frames = list_surfaces(tmp_path / "meshes" / "sit")
    assert [path.stem for path in frames] == [f"frame_{frame}" for frame in range(12)]
    np.testing.assert_allclose(read_surface(frames[10])[0], animal.posed(motion)[10], atol=1e-6)
