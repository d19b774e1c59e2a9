"""The built-in subjects in clothes: a closed surface off the body, the skin of the body, folds that depend on the pose."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh
from licensed_files import write_body
from scipy.spatial import cKDTree

from snarfcli.bodies import builtin_body
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject
from snarfcli.datasets.clothed import clothed_subject, load, outfit_of, subjects
from snarfcli.datasets.posed_meshes import ArrayMeshes
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.sampling import check_mesh, occupancies

SUBJECT = "50002"
_LEAST_STAND_OFF_M = 0.012


@pytest.fixture(scope="module")
def person():
    return clothed_subject(SUBJECT)


@pytest.fixture(scope="module")
def bare():
    return builtin_subject(SUBJECT)


@pytest.fixture(scope="module")
def clothed(person):
    return person.sequences[0].meshes.clothed


@pytest.fixture(scope="module")
def distance(clothed, bare):
    """Distance of each vertex of the clothed mesh from the bare body: to the nearest of many points on it, [V] metres."""
    body = trimesh.Trimesh(bare.template.vertices, bare.template.faces, process=False)
    points, _ = trimesh.sample.sample_surface(body, 400_000, seed=0)
    return cKDTree(np.concatenate([points, body.vertices])).query(clothed.mesh.vertices)[0]


def bent(person, joint: str, axis_angle) -> np.ndarray:
    """Return the canonical pose [1, J, 3] with one joint turned in place of how it is there."""
    pose = person.skeleton.canonical_pose.numpy().astype(np.float64).copy()
    pose[person.skeleton.names.index(joint)] = axis_angle
    return pose[None]


def test_the_same_person_as_without_clothes(person, bare):
    assert find_dataset("clothed").subjects is subjects
    assert person.data == "clothed"
    assert [(s.name, s.split) for s in person.sequences] == [(s.name, s.split) for s in bare.sequences]
    for one, other in zip(person.sequences, bare.sequences, strict=True):
        assert np.array_equal(one.motion.poses, other.motion.poses)
        assert len(one.meshes) == one.motion.num_frames
    assert torch.equal(person.skeleton.joints_rest, bare.skeleton.joints_rest)


def test_template_is_the_bare_body(person, bare):
    """A system that needs a skinned base mesh gets the body below the clothes, as with SMPL below CAPE's scans."""
    assert np.array_equal(person.template.vertices, bare.template.vertices)
    assert np.array_equal(person.template.weights, bare.template.weights)


def test_closed_and_outward_in_the_canonical_and_in_extreme_poses(person, clothed, bare):
    assert check_mesh(clothed.mesh.vertices, clothed.mesh.faces, "parity") == 0  # no edge is open
    volume = trimesh.Trimesh(clothed.mesh.vertices, clothed.mesh.faces, process=False).volume
    body = trimesh.Trimesh(bare.template.vertices, bare.template.faces, process=False).volume
    assert 1.15 * body < volume < 1.7 * body  # litres of cloth and air
    for sequence in person.of_split("ood"):
        vertices, faces = sequence.meshes[len(sequence.meshes) // 2]
        assert check_mesh(vertices, faces, "parity") == 0


def test_cloth_stands_off_the_body_and_skin_does_not(clothed, distance):
    stand_off, outfit = clothed.mesh.stand_off_m, outfit_of(SUBJECT)
    # Points are 2.2 mm apart on average, so that the nearest is off by a millimetre or two where the distance is small.
    np.testing.assert_allclose(distance, stand_off, atol=3e-3)
    is_skin = stand_off < 1e-5
    assert 0.2 < is_skin.mean() < 0.7
    assert stand_off.max() < outfit.stand_off_m + outfit.flare_m + 0.03  # hollows are bridged
    cloth = stand_off[~is_skin]
    # The rest are rims, from the skin out to the edge of the cloth.
    assert np.median(cloth) > outfit.stand_off_m
    assert (cloth > 0.9 * _LEAST_STAND_OFF_M).mean() > 0.9


def test_trunk_is_covered_and_hands_feet_and_head_are_not(clothed, bare):
    vertices = bare.template.vertices
    bones = [bare.skeleton.names[i] for i in bare.template.weights.argmax(1)]
    depth = cKDTree(clothed.mesh.vertices).query(vertices)[0]
    inside = occupancies(clothed.mesh.vertices, clothed.mesh.faces, vertices)
    trunk = np.array([bone in ("spine1", "spine2") for bone in bones])
    assert inside[trunk].all()
    assert depth[trunk].min() > 0.7 * _LEAST_STAND_OFF_M
    shown = np.array([bone in ("head", "l_hand", "r_hand", "l_foot", "r_foot", "l_ankle") for bone in bones])
    assert shown.any()
    assert depth[shown].max() < 0.01
    assert np.median(depth[shown]) < 1e-6


def test_skin_moves_with_the_body(person, clothed, bare):
    near, number = cKDTree(bare.template.vertices).query(clothed.mesh.vertices)
    is_same = near < 1e-6
    assert is_same.sum() > 2000
    for name in ("splits", "deep_squats"):
        one, other = (next(s for s in data.sequences if s.name == name).meshes for data in (person, bare))
        frame = len(one) // 2
        np.testing.assert_allclose(one[frame][0][is_same], other[frame][0][number[is_same]], atol=1e-5)


def test_folds_are_shallower_than_the_stand_off_and_none_in_the_canonical_pose(person, clothed):
    folds, stand_off = clothed.folds, clothed.mesh.stand_off_m
    height = folds.displacement(clothed.turned(person.skeleton.canonical_pose.numpy()[None]))
    assert np.abs(height).max() < 1e-6
    np.testing.assert_allclose(clothed.pose(person.skeleton.canonical_pose.numpy()[None])[0], clothed.mesh.vertices, atol=1e-6)
    poses = np.concatenate([sequence.motion.poses[::97] for sequence in person.of_split("ood")])
    height = folds.displacement(clothed.turned(poses))
    assert (np.abs(height) <= 0.6 * stand_off + 1e-12).all()
    assert 0.008 < np.abs(height).max() < 0.02
    assert np.abs(height[:, stand_off < 1e-5]).max() < 1e-5


@pytest.mark.parametrize(
    ("joint", "axis_angle"), [("l_hip", (-1.2, 0, 0.5)), ("spine2", (0, 0.4, 0)), ("r_shoulder", (0, 0, 1.2))]
)
def test_folds_come_with_the_joint_that_bends_and_only_near_it(person, clothed, joint, axis_angle):
    folds = clothed.folds
    height = folds.displacement(clothed.turned(bent(person, joint, axis_angle)))[0]
    at = person.skeleton.canonical_joints[person.skeleton.names.index(joint)].numpy()
    away = np.linalg.norm(clothed.mesh.vertices - at, axis=1)
    assert np.abs(height[away < 0.2]).max() > 0.004
    assert np.abs(height[away > 0.37]).max() < 1e-6
    assert height.min() < -0.002
    assert height.max() > 0.002


def test_a_small_change_of_pose_is_a_small_change_of_the_cloth(person, clothed):
    generator = np.random.default_rng(0)
    pose = person.of_split("ood")[0].motion.poses[100:101].copy()
    step = generator.standard_normal(pose.shape)
    step /= np.abs(step).max()
    for size in (1e-3, 1e-5):
        # Limbs of a metre turn by up to a dozen joints' steps.
        moved = np.abs(clothed.pose(pose + size * step) - clothed.pose(pose)).max()
        assert 0.1 * size < moved < 12 * size


def test_frames_are_the_same_alone_and_together(person):
    meshes = person.sequences[0].meshes
    together = meshes.chosen(np.array([3, 40]))
    assert isinstance(together, ArrayMeshes)  # which worker processes get without PyTorch
    for index, frame in enumerate((3, 40)):
        vertices, faces = meshes[frame]
        assert vertices.dtype == np.float32
        assert faces.dtype == np.int32
        np.testing.assert_allclose(together[index][0], vertices, atol=1e-6)
    assert meshes.source(0) == ""
    assert meshes.fingerprint() == ""


def test_another_process_makes_the_same_clothes(person):
    code = (
        "import hashlib, numpy as np; from snarfcli.datasets.clothed import clothed_subject;"
        f"v, f = clothed_subject('{SUBJECT}').sequences[0].meshes[7];"
        "print(hashlib.sha256(v.tobytes() + f.tobytes()).hexdigest())"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()[-1]
    vertices, faces = person.sequences[0].meshes[7]
    assert hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest() == other


def test_everybody_has_clothes_of_their_own():
    outfits = [outfit_of(subject) for subject in BUILTIN_SUBJECTS]
    assert len(set(outfits)) == len(outfits)
    assert outfits == [outfit_of(subject) for subject in BUILTIN_SUBJECTS]
    assert {(o.sleeve > 0.5, o.leg > 0.5) for o in outfits} == {(a, b) for a in (False, True) for b in (False, True)}


def test_a_body_of_ones_own_and_an_unknown_subject(tmp_path):
    path = write_body(tmp_path / "smpl" / "models").rename(tmp_path / "smpl" / "models" / "SMPL_NEUTRAL.npz")
    request = Request(DataConfig("clothed", 1, 1, 1), tmp_path, body=str(tmp_path / "smpl"))
    own = load("50004", request)
    assert own.sources[0] == f"body {path}"
    assert "long sleeves, short trousers" in own.sources[-1]
    assert own.sequences[0].meshes.clothed.body.num_joints == builtin_body().num_joints
    with pytest.raises(UserError, match="no built-in subject '50003'"):
        load("50003", Request(request.config, tmp_path))
