"""Rigs that are fitted in place of a body: a small four-legged animal."""

from __future__ import annotations

import json

import numpy as np
import pytest
from toy_animal import Animal, animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_bvh, write_mesh
from toy_gltf import GltfBuilder

from snarfcli.errors import UserError
from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.rest_weights import weights_of_bones
from snarfcli.registration.rigs import RigSurface, read_rig
from snarfcli.registration.rotations import vector_to_matrix
from snarfcli.registration.same_topology import fit_one_topology
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior, fit_state, scales


@pytest.fixture(scope="module")
def animal() -> Animal:
    return make_animal(0.04)


@pytest.fixture(scope="module")
def rig(animal, tmp_path_factory) -> RigSurface:
    path = tmp_path_factory.mktemp("rig") / "animal.glb"
    path.write_bytes(animal_glb(animal, [animal_motion("walk"), animal_motion("sit")]))
    return read_rig(path)


def write_skeleton(folder, animal: Animal, suffix: str = ".npz", **more) -> None:
    content = {"names": np.array(animal.names), "parents": np.array(animal.parents), "joints_rest": animal.joints, **more}
    if suffix == ".npz":
        np.savez(folder / "animal.npz", **content)
    else:
        lists = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in content.items()}
        (folder / "animal.json").write_text(json.dumps(lists))


def scan_of(vertices: np.ndarray, rig: RigSurface, state: BodyState, count: int = 1500) -> ScanPoints:
    surface = rig.surface(10**6)
    return ScanPoints.sampled(vertices, surface.posed(state).normals, count)


def test_a_rigged_file_gives_joints_weights_and_poses(rig, animal):
    assert rig.skeleton.names == animal.names
    assert rig.skeleton.parents == animal.parents
    np.testing.assert_allclose(rig.skeleton.joints_rest.numpy(), animal.joints, atol=1e-6)
    assert rig.vertices.shape == animal.vertices.shape
    assert [(name, poses.shape) for name, poses in rig.motions] == [("walk", (12, 19, 3)), ("sit", (12, 19, 3))]  # 7.5 a second
    assert len(rig.library.poses) == 25
    assert len(rig.library_without(["walk"]).poses) == 13
    assert "19 joints" in rig.source
    assert "2 motions" in rig.source
    walk = animal_motion("walk").poses[::4]
    np.testing.assert_allclose(vector_to_matrix(rig.motions[0][1]), vector_to_matrix(walk), atol=1e-5)


def test_the_size_is_the_shape(rig, animal):
    surface = rig.surface(100)
    larger = surface.posed(BodyState.from_pose(np.zeros((19, 3)), np.zeros(3), np.array([2.0])))
    np.testing.assert_allclose(larger.points, 1.2 * surface.points_rest, atol=1e-12)
    np.testing.assert_allclose(larger.joints, 1.2 * surface.joints_rest, atol=1e-12)
    np.testing.assert_allclose(rig.shaped(np.array([2.0])).vertices, 1.2 * rig.vertices)
    pose = animal_motion("walk").poses[5]
    state = BodyState.from_pose(pose, np.array([0.0, 1.0, 0.0]), np.array([2.0]))
    vertices, faces = rig.mesh(state)
    np.testing.assert_allclose(vertices[surface.vertex_numbers], surface.posed(state).points, atol=1e-6)
    assert faces.shape == animal.faces.shape


def test_pose_and_size_are_found(rig, animal):
    motion = animal_motion("walk")
    vertices = 1.15 * animal.posed(motion)[6] + np.array([1.0, 0, 0])
    true = BodyState.from_pose(motion.poses[6], np.array([1.0, 0, 0]), np.array([1.5]))
    scan = scan_of(vertices, rig, true)
    surface = rig.surface(500)
    start = BodyState.from_pose(np.zeros((19, 3)), np.array([1.0, 0, 0]), np.zeros(1))
    found = fit_state(surface, start, scan, scales(0.2, 0.02, 20), PosePrior.weak(19), shape_is_free=True)
    joints = surface.joints(found) - 1.15 * animal.place(motion.poses, motion.translation)[6, :, :3, 3] - [1.0, 0, 0]
    assert found.betas[0] == pytest.approx(1.5, abs=0.2)
    assert np.linalg.norm(joints, axis=1).mean() < 0.012


def test_the_size_of_scans_is_estimated(rig, animal):
    true = BodyState.from_pose(np.zeros((19, 3)), np.zeros(3), np.zeros(1))
    scans = [scan_of(3.0 * vertices, rig, true) for vertices in animal.posed(animal_motion("walk"))[::12]]
    assert rig.sized_to(scans).length_m == pytest.approx(3.0 * rig.length_m, rel=0.1)


def test_frames_of_the_rigs_own_mesh_are_followed_exactly(rig, animal):
    motion = animal_motion("sit", 12)
    posed = 1.1 * animal.posed(motion)
    fitted = fit_one_topology(rig.surface(10**6), rig.faces, animal.faces, lambda frame: posed[frame], 12, {})
    assert fitted.betas[0] == pytest.approx(1.0, abs=0.01)
    surface = rig.surface(100)
    joints = 1.1 * (animal.place(motion.poses, motion.translation)[..., :3, 3])
    for frame in range(12):
        state = BodyState.from_pose(fitted.poses[frame], fitted.translation[frame], fitted.betas)
        np.testing.assert_allclose(surface.joints(state), joints[frame], atol=1e-3)


def test_a_root_that_moves_nothing_does_not_turn(animal, tmp_path):
    above = Animal(
        ("floor", *animal.names),
        (-1, *(parent + 1 for parent in animal.parents)),
        np.concatenate([np.zeros((1, 3)), animal.joints]),
        animal.vertices,
        animal.faces,
        np.concatenate([np.zeros((len(animal.vertices), 1)), animal.weights], 1),
    )
    motion = animal_motion("sit")
    poses = np.concatenate([np.zeros((48, 1, 3)), motion.poses], 1)
    (tmp_path / "animal.glb").write_bytes(animal_glb(above, [type(motion)("sit", poses, motion.translation)]))
    rig = read_rig(tmp_path / "animal.glb")
    assert rig.skeleton.idle == (0,)
    ((_, found),) = rig.motions
    np.testing.assert_allclose(found[:, 0], motion.poses[::4, 0], atol=1e-5)
    np.testing.assert_allclose(found[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(found[:, 2:], motion.poses[::4, 1:], atol=1e-5)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_skeleton_file_with_its_own_mesh(animal, tmp_path, suffix):
    arrays = {"vertices": animal.vertices, "faces": animal.faces, "weights": animal.weights}
    write_skeleton(tmp_path, animal, suffix, **arrays, scale=2.0)
    rig = read_rig(tmp_path / f"animal{suffix}")
    np.testing.assert_allclose(rig.vertices, 2 * animal.vertices)
    np.testing.assert_allclose(rig.skeleton.joints_rest.numpy(), 2 * animal.joints)
    np.testing.assert_allclose(rig.weights, animal.weights, atol=1e-9)
    assert rig.motions == ()
    assert len(rig.library.poses) == 1


def test_weights_follow_joints_that_are_sorted(animal, tmp_path):
    order = np.arange(19)[::-1]
    parents = np.array([18 - parent if parent >= 0 else -1 for parent in animal.parents])[order]
    np.savez(
        tmp_path / "animal.npz",
        names=np.array(animal.names)[order],
        parents=parents,
        joints_rest=animal.joints[order],
        vertices=animal.vertices,
        faces=animal.faces,
        weights=animal.weights[:, order],
    )
    rig = read_rig(tmp_path / "animal.npz")
    columns = [rig.skeleton.names.index(name) for name in animal.names]
    np.testing.assert_allclose(rig.weights[:, columns], animal.weights, atol=1e-9)


@pytest.mark.parametrize("is_beside", [True, False])
def test_a_mesh_file_and_weights_from_the_bones(animal, tmp_path, is_beside):
    write_skeleton(tmp_path, animal, up="z")
    mesh = tmp_path / ("animal.obj" if is_beside else "rest.ply")
    write_mesh(mesh, animal.vertices, animal.faces)
    rig = read_rig(tmp_path / "animal.npz", None if is_beside else mesh)
    np.testing.assert_allclose(rig.vertices[:, [0, 2, 1]], animal.vertices * [1, -1, 1], atol=1e-6)  # y up
    assert "computed weights" in rig.source
    np.testing.assert_allclose(rig.weights.sum(1), 1)
    assert np.abs(rig.weights - animal.weights).sum(1).mean() < 0.4  # of 2; measured 0.35


def test_a_motion_of_bvh_is_a_skeleton(animal, tmp_path):
    write_animal_bvh(tmp_path / "animal.bvh", animal, animal_motion("walk"))
    write_mesh(tmp_path / "animal.obj", animal.vertices, animal.faces)
    rig = read_rig(tmp_path / "animal.bvh")
    assert set(rig.skeleton.names) == set(animal.names)


def test_weights_of_bones_do_not_cross_to_other_limbs(rig, animal):
    weights = weights_of_bones(rig.skeleton, animal.vertices, animal.faces)
    paws = [animal.names.index(f"{side}_front_paw") for side in "lr"]
    right = animal.vertices[:, 0] < -0.03
    assert weights[right, paws[0]].max() < 0.02
    assert weights[:, paws[0]].max() > 0.8


def test_what_is_no_rig_is_one_line(animal, tmp_path):
    def message(name: str, mesh=None) -> str:
        with pytest.raises(UserError) as error:
            read_rig(tmp_path / name, mesh)
        assert "\n" not in str(error.value)
        return str(error.value)

    assert "does not exist" in message("none.glb") or "no " in message("none.glb")
    assert "wanted a file ending in .glb" in message("animal.fbx")
    (tmp_path / "broken.glb").write_bytes(b"glTF" + bytes(30))
    assert "broken.glb" in message("broken.glb")
    (tmp_path / "empty.glb").write_bytes(GltfBuilder(scenes=[{"nodes": []}], nodes=[]).glb())
    assert "empty.glb" in message("empty.glb")
    write_skeleton(tmp_path, animal)
    assert "has no mesh" in message("animal.npz")
    write_mesh(tmp_path / "far.obj", animal.vertices + 10, animal.faces)
    assert "around the joints of animal.npz" in message("animal.npz", tmp_path / "far.obj")
    write_mesh(tmp_path / "small.obj", 0.01 * animal.vertices, animal.faces)
    write_skeleton(tmp_path, animal, vertices=animal.vertices, faces=animal.faces, weights=animal.weights[:-1])
    assert "one per vertex" in message("animal.npz")
    write_skeleton(tmp_path, animal, vertices=animal.vertices, faces=animal.faces, weights=2 * animal.weights)
    assert "sum of 1" in message("animal.npz")
    write_skeleton(tmp_path, animal, vertices=animal.vertices, faces=animal.faces + 1)
    assert "faces: wanted numbers" in message("animal.npz")
    (tmp_path / "whole.glb").write_bytes(animal_glb(animal, [animal_motion("walk")]))
    assert "leave it out" in message("whole.glb", tmp_path / "far.obj")
