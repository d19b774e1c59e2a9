"""Motions of other rigs on SMPL's joints: bones point the same way, feet stay where they are."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_animal import animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_bvh
from toy_rigs import CMU_NAMES, MIXAMO_NAMES, a_pose, rig_of, write_bvh

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, builtin_body, forward_kinematics, legs_apart_pose
from snarfcli.errors import UserError
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS, joint_positions
from snarfcli.motions.retarget import choose_clip, retarget_rig

STANDING = builtin_motion("jumping_jacks", 3, duration_s=0.5)
EXTREME = builtin_motion("deep_squats", 1, duration_s=0.5)
LYING = builtin_motion("bridges", 0, duration_s=0.5)
FEW = 1e-6  # metres; angles written to 1e-9 degrees, measured worst 4e-8


def smpl(rest=JOINTS_REST, names=SMPL_JOINT_NAMES):
    return Skeleton(names, PARENTS, torch.as_tensor(rest), torch.zeros(24, 3))


def places(motion):
    return joint_positions(motion.poses, motion.translation)[0]


def bones(points):
    offsets = points[..., 1:, :] - points[..., list(PARENTS[1:]), :]
    return offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)


@pytest.mark.parametrize("motion", [STANDING, EXTREME], ids=lambda motion: motion.name)
def test_the_skeletons_own_rig_gives_its_poses_back(tmp_path, motion):
    path = write_bvh(tmp_path / "own.bvh", rig_of(motion.poses, motion.translation, frame_rate=motion.frame_rate))
    back = read_motion(path)
    assert back.name == "own"
    assert back.frame_rate == motion.frame_rate
    difference = Rotation.from_rotvec(back.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(motion.poses.reshape(-1, 3))
    assert difference.magnitude().max() < 1e-7
    np.testing.assert_allclose(back.translation, motion.translation, atol=1e-7)


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("motion", [STANDING, EXTREME, LYING], ids=lambda motion: motion.name)
def test_its_own_rig_may_rest_in_another_pose(motion, scale):
    """Exported avatars rest with their legs apart; feet must not be taken to be turned for that."""
    skeleton = replace(smpl(), canonical_pose=legs_apart_pose(SMPL_JOINT_NAMES, torch.float64))
    frames = forward_kinematics(
        torch.cat([skeleton.canonical_pose[None], torch.as_tensor(motion.poses)]),
        skeleton.joints_rest,
        PARENTS,
        torch.cat([torch.zeros(1, 3, dtype=torch.float64), torch.as_tensor(motion.translation)]),
    )
    at = np.tile(np.eye(4), (len(motion.poses) + 1, 24, 1, 1))
    at[:, :, :3, :3], at[:, :, :3, 3] = frames[1][:, :, :3, :3], scale * frames[0].numpy()
    rig = Rig(SMPL_JOINT_NAMES, PARENTS, at[0], (RigClip("own", motion.frame_rate, at[1:]),))
    back = retarget_rig(rig, rig.clips[0], skeleton, path=Path("own.glb"), name="own").motion
    difference = Rotation.from_rotvec(back.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(motion.poses.reshape(-1, 3))
    assert difference.magnitude().max() < 1e-6
    np.testing.assert_allclose(back.translation, motion.translation, atol=1e-6)


@pytest.mark.parametrize("names", [CMU_NAMES, MIXAMO_NAMES, SMPL_JOINT_NAMES], ids=["cmu", "mixamo", "smpl"])
@pytest.mark.parametrize("rest", ["t_pose", "a_pose"])
@pytest.mark.parametrize("facing_deg", [0, 180, 50])
@pytest.mark.parametrize("motion", [STANDING, EXTREME], ids=lambda motion: motion.name)
def test_other_names_rest_poses_and_units(tmp_path, names, rest, facing_deg, motion):
    turn = Rotation.from_euler("y", facing_deg, degrees=True)
    rest_pose = a_pose() if rest == "a_pose" else np.zeros((24, 3))
    rig = rig_of(motion.poses, motion.translation, names, rest_pose=rest_pose, world=turn, scale=100)  # centimetres
    back = read_motion(write_bvh(tmp_path / "walk.bvh", rig, "ZYX"))
    expected = turn.apply(places(motion).reshape(-1, 3)).reshape(-1, 24, 3)
    if rest == "t_pose":
        np.testing.assert_allclose(places(back), expected, atol=FEW)
    # Feet are taken to rest on the floor, so they differ by what is left of the ankles' turns in this rest pose: 6 degrees.
    limbs = [joint - 1 for joint in range(1, 24) if SMPL_JOINT_NAMES[joint] not in ("l_foot", "r_foot")]
    np.testing.assert_allclose(bones(places(back))[:, limbs], bones(expected)[:, limbs], atol=1e-7)
    np.testing.assert_allclose(places(back)[:, :9], expected[:, :9], atol=FEW)  # and they stand where they stood
    angle = np.arccos(np.clip((bones(places(back)) * bones(expected)).sum(-1), -1, 1))
    assert angle.max() < np.radians(7)


def test_z_up_is_found_and_turned(tmp_path, caplog):
    turn = Rotation.from_euler("x", 90, degrees=True)
    path = write_bvh(tmp_path / "z.bvh", rig_of(STANDING.poses, STANDING.translation, CMU_NAMES, world=turn, scale=39.37))
    with caplog.at_level(logging.INFO, "snarfcli"):
        back = read_motion(path)
    assert "z is up in this file" in caplog.text
    np.testing.assert_allclose(places(back), places(STANDING), atol=FEW)
    np.testing.assert_allclose(places(read_motion(path, up="z")), places(STANDING), atol=FEW)
    lying = read_motion(path, up="y")
    np.testing.assert_allclose(places(lying), turn.apply(places(STANDING).reshape(-1, 3)).reshape(-1, 24, 3), atol=FEW)


def test_a_rig_at_rest_in_y_up_moving_in_z_up(tmp_path):
    """As AMASS's poses come out when they are written as BVH without a thought."""
    turn = Rotation.from_euler("x", 90, degrees=True)
    poses = STANDING.poses.copy()
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    way = turn.apply(STANDING.translation + JOINTS_REST[0]) - JOINTS_REST[0]
    back = read_motion(write_bvh(tmp_path / "amass.bvh", rig_of(poses, way, MIXAMO_NAMES)))
    np.testing.assert_allclose(places(back), places(STANDING), atol=FEW)


def test_someone_lying_in_y_up_is_left_lying(tmp_path):
    """On the side: the rest pose says what is up where the motion does not."""
    poses = np.zeros((5, 24, 3))
    poses[:, 0, 2] = np.pi / 2
    back = read_motion(write_bvh(tmp_path / "lie.bvh", rig_of(poses, np.zeros((5, 3)), CMU_NAMES)))
    np.testing.assert_allclose(back.poses, poses, atol=1e-7)


def test_other_proportions_keep_directions_and_the_floor(tmp_path):
    path = write_bvh(tmp_path / "tall.bvh", rig_of(STANDING.poses, STANDING.translation, CMU_NAMES, scale=100))
    small = JOINTS_REST.copy()
    small[:, 1] *= 0.8
    small[:, 0] *= 0.7
    skeleton = smpl(small)
    motion = read_motion(path, skeleton)
    poses, way = torch.from_numpy(motion.poses), torch.from_numpy(motion.translation)
    joints = forward_kinematics(poses, skeleton.joints_rest, PARENTS, way)[0].numpy()
    limbs = [j - 1 for j in (4, 5, 7, 8, 18, 19, 20, 21)]  # the bones of thighs, shanks, upper arms and forearms
    np.testing.assert_allclose(bones(joints)[:, limbs], bones(places(STANDING))[:, limbs], atol=1e-6)
    legs = [np.linalg.norm(rest[1] - rest[4]) + np.linalg.norm(rest[4] - rest[7]) for rest in (small, JOINTS_REST)]
    scale = legs[0] / legs[1]
    feet, wanted = joints[:, 7:9, 1], scale * places(STANDING)[:, 7:9, 1]
    assert np.abs(feet - wanted).max() < 0.02  # metres; hips are narrower by more than legs are shorter


def test_cmu_tree_with_joints_between(tmp_path):
    """CMU's files have a joint before each hip and two in the neck, and a spine whose first bone has no length."""
    rig = rig_of(STANDING.poses, STANDING.translation, CMU_NAMES)
    names, parents = [*rig.names], [*rig.parents]
    rest, posed = [*rig.rest], [*rig.clips[0].world_from_joint.transpose(1, 0, 2, 3)]
    for new, above, below in (("LHipJoint", 0, (1,)), ("RHipJoint", 0, (2,)), ("Neck1", 12, (15,))):
        for joint in below:
            parents[joint] = len(names)
        names.append(new)
        parents.append(above)
        rest.append(rest[above].copy())
        posed.append(posed[above].copy())
    order = [0, 24, 25, *range(1, 15), 26, *range(15, 24)]
    place = {old: new for new, old in enumerate(order)}
    rig = Rig(
        tuple(names[j] for j in order),
        tuple(place.get(parents[j], -1) for j in order),
        np.stack([rest[j] for j in order]),
        (replace(rig.clips[0], world_from_joint=np.stack([posed[j] for j in order], 1)),),
    )
    back = read_motion(write_bvh(tmp_path / "cmu.bvh", rig))
    np.testing.assert_allclose(places(back), places(STANDING), atol=FEW)


def test_scaled_joints_and_float32(tmp_path):
    """As glTF files have them: an armature in centimetres, and rotations to seven digits."""
    rig = rig_of(STANDING.poses, STANDING.translation, MIXAMO_NAMES)
    size = np.diag([100.0, 100, 100, 1])
    posed = (rig.clips[0].world_from_joint @ size).astype(np.float32).astype(np.float64)
    rig = Rig(rig.names, rig.parents, rig.rest @ size, (RigClip("walk", 30.0, posed),))
    back = retarget_rig(rig, rig.clips[0], smpl(), path=tmp_path / "a.glb", name="a").motion
    np.testing.assert_allclose(places(back), places(STANDING), atol=2e-6)


def test_joints_without_counterpart_follow_their_parents(tmp_path, caplog):
    keep = [j for j in range(24) if SMPL_JOINT_NAMES[j] not in ("l_hand", "r_hand", "l_foot", "r_foot", "spine2", "head")]
    rig = rig_of(STANDING.poses, STANDING.translation, CMU_NAMES)
    parents = [keep.index(p if p in keep else PARENTS[p]) if p >= 0 else -1 for p in (PARENTS[j] for j in keep)]
    clip = replace(rig.clips[0], world_from_joint=rig.clips[0].world_from_joint[:, keep])
    part = Rig(tuple(rig.names[j] for j in keep), tuple(parents), rig.rest[keep], (clip,))
    with caplog.at_level(logging.INFO, "snarfcli"):
        back = read_motion(write_bvh(tmp_path / "part.bvh", part))
    assert "follow their parents: spine2, l_foot, r_foot, head, l_hand, r_hand" in caplog.text
    np.testing.assert_array_equal(back.poses[:, [6, 10, 11, 15, 22, 23]], 0)
    limbs = [1, 2, 4, 5, 7, 8, 13, 14, 16, 17, 18, 19, 20, 21]
    ends = np.array(limbs) - 1
    np.testing.assert_allclose(bones(places(back))[:, ends[6:]], bones(places(STANDING))[:, ends[6:]], atol=1e-6)


def test_a_rig_skeleton_takes_motions_of_its_own_and_of_others(tmp_path):
    own = Skeleton(MIXAMO_NAMES, PARENTS, torch.from_numpy(JOINTS_REST), torch.zeros(24, 3))
    path = write_bvh(tmp_path / "cmu.bvh", rig_of(STANDING.poses, STANDING.translation, CMU_NAMES, scale=100))
    np.testing.assert_allclose(places(read_motion(path, own)), places(STANDING), atol=FEW)


def test_a_skeleton_that_is_no_human_body(tmp_path):
    """Three bones in a row, bent at rest in the file and straight in the skeleton."""
    skeleton = Skeleton(("a", "b", "c"), (-1, 0, 1), torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 2, 0]]), torch.zeros(3, 3))
    text = (
        "HIERARCHY\nROOT a { OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        "JOINT b { OFFSET 0 5 0 CHANNELS 3 Zrotation Xrotation Yrotation\nJOINT c { OFFSET 5 0 0 CHANNELS 0\n} } }\n"
        "MOTION\nFrames: 2\nFrame Time: 0.1\n0 0 0 0 0 0 0 0 0\n5 0 0 0 0 0 90 0 0\n"
    )
    (tmp_path / "a.bvh").write_text(text)
    motion = read_motion(tmp_path / "a.bvh", skeleton, up="y")
    poses, way = torch.from_numpy(motion.poses), torch.from_numpy(motion.translation)
    ends = forward_kinematics(poses, skeleton.joints_rest.double(), skeleton.parents, way)[0]
    expected = [[[0, 0, 0], [0, 1, 0], [1, 1, 0]], [[1, 0, 0], [1, 1, 0], [1, 2, 0]]]
    np.testing.assert_allclose(ends, expected, atol=1e-6)


def test_mapping_files(tmp_path):
    names = tuple(f"bone {number}" for number in range(24))
    path = write_bvh(tmp_path / "odd.bvh", rig_of(STANDING.poses, STANDING.translation, names))
    message = "no joint for pelvis, l_hip, .*give mapping=FILE.json with .*; the file has bone 0, bone 1"
    with pytest.raises(UserError, match=message) as error:
        read_motion(path)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000
    mapping = dict(zip(SMPL_JOINT_NAMES, names, strict=True))
    (tmp_path / "map.json").write_text(json.dumps(mapping))
    np.testing.assert_allclose(places(read_motion(path, mapping=tmp_path / "map.json")), places(STANDING), atol=FEW)
    spelt = {name.replace("l_", "Left ").title(): source.upper() for name, source in mapping.items()}
    np.testing.assert_allclose(places(read_motion(path, mapping=spelt)), places(STANDING), atol=FEW)
    straight = read_motion(path, mapping=mapping | {"head": None})
    np.testing.assert_array_equal(straight.poses[:, 15], 0)


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"l_hop": "LeftUpLeg"}, "the skeleton has no joint 'l_hop'; did you mean 'l_hip'\\? It has pelvis, l_hip"),
        ({"l_hip": "LeftUpLge"}, "has no joint 'LeftUpLge'; did you mean 'LeftUpLeg'\\? It has Hips, LeftUpLeg"),
        (["l_hip"], 'wanted {"joint of the skeleton": "joint of the file" or null'),
        ({"l_hip": 3}, 'wanted {"joint of the skeleton"'),
    ],
)
def test_mappings_that_are_none(tmp_path, mapping, message):
    path = write_bvh(tmp_path / "walk.bvh", rig_of(STANDING.poses, STANDING.translation, CMU_NAMES))
    (tmp_path / "map.json").write_text(json.dumps(mapping))
    with pytest.raises(UserError, match=message) as error:
        read_motion(path, mapping=tmp_path / "map.json")
    assert "map.json" in str(error.value)
    assert str(error.value).isprintable()
    with pytest.raises(UserError, match="no mapping at"):
        read_motion(path, mapping=tmp_path / "none.json")


def test_choosing_clips(tmp_path, caplog):
    rig = rig_of(STANDING.poses, STANDING.translation)
    rig = replace(rig, clips=tuple(replace(rig.clips[0], name=name) for name in ("idle", "run", "0")))
    with caplog.at_level(logging.INFO, "snarfcli"):
        assert choose_clip(rig, None, tmp_path / "a.glb").name == "idle"
    assert "clip 0 of 3 is used; others by clip=NAME or number (0: 'idle', 1: 'run', 2: '0')" in caplog.text
    assert choose_clip(rig, "run", tmp_path).name == "run"
    assert choose_clip(rig, 1, tmp_path).name == "run"
    assert choose_clip(rig, "0", tmp_path).name == "0"
    assert choose_clip(rig, "2", tmp_path).name == "0"
    with pytest.raises(UserError, match=r"a.glb has no clip 'rum'; did you mean 'run'\? It has 'idle', 'run', '0'"):
        choose_clip(rig, "rum", tmp_path / "a.glb")
    with pytest.raises(UserError, match="has no motion"):
        choose_clip(replace(rig, clips=()), None, tmp_path / "a.glb")


def test_rigs_that_cannot_be_used(tmp_path):
    rig = rig_of(STANDING.poses, STANDING.translation, CMU_NAMES)
    path = tmp_path / "a.glb"
    flat, lost, far = (rig.rest.copy(), rig.clips[0].world_from_joint.copy(), rig.clips[0].world_from_joint.copy())
    flat[4, :3, 0] = 0
    lost[2, 4, 0, 3] = np.nan
    far[0, :, 0, 3] = 1e9
    for bad, message in (
        (replace(rig, rest=flat), "a.glb: joint 'LeftLeg' has scale 0 at rest"),
        (replace(rig, clips=(replace(rig.clips[0], world_from_joint=lost),)), "'LeftLeg' has NaN or infinity in frame 2"),
        (replace(rig, clips=(replace(rig.clips[0], world_from_joint=far),)), "the body moves over 1000 km away"),
        (replace(rig, clips=(replace(rig.clips[0], world_from_joint=far[:0]),)), "clip 'walk': wanted at least 1 frame, got 0"),
        (replace(rig, rest=rig.rest * np.nan), "has NaN or infinity in its rest pose"),
    ):
        with pytest.raises(UserError, match=message):
            retarget_rig(bad, bad.clips[0], smpl(), path=path, name="a")


def test_the_built_in_body_takes_it_too(tmp_path):
    path = write_bvh(tmp_path / "walk.bvh", rig_of(STANDING.poses, STANDING.translation, CMU_NAMES, rest_pose=a_pose()))
    motion = read_motion(path, builtin_body().skeleton())
    assert motion.poses.shape == STANDING.poses.shape
    assert motion.poses.dtype == np.float64
    assert np.abs(motion.translation - STANDING.translation).max() < 0.1  # the two bodies are of about one size


@pytest.mark.parametrize("kind", ["glb", "bvh"])
@pytest.mark.parametrize("clip", ["walk", "sit"])
def test_an_animals_own_files_give_its_poses_back(tmp_path, kind, clip):
    animal, motion = make_animal(0.08), animal_motion(clip, 6)
    skeleton = Skeleton(animal.names, animal.parents, torch.from_numpy(animal.joints), torch.zeros(len(animal.names), 3))
    path = tmp_path / f"animal.{kind}"
    if kind == "glb":
        path.write_bytes(animal_glb(animal, [animal_motion("trot", 3), motion]))
        back = read_motion(path, skeleton, clip=clip)
        assert back.name == f"animal_{clip}"
    else:
        write_animal_bvh(path, animal, motion)
        back = read_motion(path, skeleton)
    # glTF keeps rotations in float32
    tolerance = 1e-6 if kind == "glb" else 1e-5
    np.testing.assert_allclose(back.poses[: len(motion.poses)], motion.poses, atol=tolerance)
    np.testing.assert_allclose(back.translation[: len(motion.poses)], motion.translation, atol=tolerance)


def test_a_human_motion_on_an_animal_is_refused_with_its_joints(tmp_path):
    animal = make_animal(0.08)
    skeleton = Skeleton(animal.names, animal.parents, torch.from_numpy(animal.joints), torch.zeros(len(animal.names), 3))
    path = write_bvh(tmp_path / "walk.bvh", rig_of(STANDING.poses, STANDING.translation, CMU_NAMES))
    message = "joints for only .* of 19; give mapping=FILE.json .*; the skeleton has pelvis, .*; the file has Hips, LeftUpLeg"
    with pytest.raises(UserError, match=message) as error:
        read_motion(path, skeleton)
    assert len(str(error.value)) < 1000
    mapping = {"pelvis": "Hips", "l_hind_upper": "LeftUpLeg", "l_hind_lower": "LeftLeg", "r_hind_upper": "RightUpLeg"}
    poses = read_motion(path, skeleton, mapping=mapping).poses
    assert np.abs(poses[:, animal.names.index("l_hind_lower")]).max() > 0.01
    np.testing.assert_array_equal(poses[:, animal.names.index("r_hind_lower")], 0)
