"""Rigs in the conventions of other programs on several subjects: rotations of the source, feet where they were, facing kept."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from other_rigs import CONVENTIONS, rig_motion
from scipy.spatial.transform import Rotation
from toy_rigs import write_bvh

from snarfcli.bodies import SMPL_JOINT_NAMES, forward_kinematics
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject
from snarfcli.errors import UserError
from snarfcli.formats.rig import Rig
from snarfcli.motions import TRAINING_SEQUENCES, builtin_motion, read_motion
from snarfcli.motions.motion import Motion
from snarfcli.motions.retarget import retarget_rig

SUBJECTS = ("50002", "50009", "50020")
FOOT_M = 0.02
TURNED = {"rokoko_along_x", "bandai_along_y", "lafan_along_x_level", "along_z_z_up", "limbs_along_x", "zero_offsets"}
"""Conventions that say nothing about the twist of a limb, which is guessed from the clip."""
LOOSE = ("wrist", "foot")  # nothing tells how these are turned: not the places of any joints


@cache
def motion_of(convention):
    """Return another motion for each convention."""
    number = list(CONVENTIONS).index(convention)
    names = [*TRAINING_SEQUENCES, "deep_squats", "lunges", "high_kicks"]
    return builtin_motion(names[number % len(names)], number, duration_s=3).slice(step=4)


@cache
def skeleton_of(subject):
    return builtin_subject(subject).skeleton


def read(tmp_path, source, skeleton, **options) -> Motion:
    convention = source.convention
    if convention.zero_offsets:  # BVH would take the lengths of the position channels
        return retarget_rig(source.rig, source.rig.clips[0], skeleton, path=tmp_path / "a.glb", name="a", **options).motion
    path = write_bvh(tmp_path / "walk.bvh", source.rig, convention.order, convention.end)
    return read_motion(path, skeleton, **options)


def posed(motion, skeleton):
    """Return the world rotations [T, J, 3, 3] and places [T, J, 3] of a skeleton in motion."""
    poses, way = torch.from_numpy(motion.poses), torch.from_numpy(motion.translation)
    places, transforms = forward_kinematics(poses, skeleton.joints_rest.double(), skeleton.parents, way)
    return transforms[..., :3, :3].numpy(), places.numpy()


def angles_deg(rotations, others):
    between = rotations.swapaxes(-1, -2) @ others
    return np.degrees(Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude()).reshape(between.shape[:-2])


def leg_length(joints):
    return sum(np.linalg.norm(joints[upper] - joints[lower]) for upper, lower in ((1, 4), (4, 7), (2, 5), (5, 8)))


@pytest.mark.parametrize("subject", SUBJECTS)
@pytest.mark.parametrize("name", CONVENTIONS)
def test_joints_turn_as_in_the_source(tmp_path, name, subject):
    source = rig_motion(motion_of(name), CONVENTIONS[name])
    skeleton = skeleton_of(subject)
    rotations, places = posed(read(tmp_path, source, skeleton), skeleton)
    joints = [joint for joint in range(22) if SMPL_JOINT_NAMES[joint] not in source.convention.without]
    angles = angles_deg(rotations[:, joints], source.rotations[:, joints]).max(0)
    limits = [25 if SMPL_JOINT_NAMES[joint][2:] in LOOSE and name in TURNED else 15 for joint in joints]
    worst = {
        SMPL_JOINT_NAMES[joint]: angle for joint, angle, limit in zip(joints, angles, limits, strict=True) if angle > limit
    }
    assert not worst

    feet = [7, 8] if "l_foot" in source.convention.without else [10, 11]
    wanted = source.places[:, feet, 1] * leg_length(skeleton.joints_rest.numpy()) / leg_length(source.places[0])
    planted = wanted < wanted.min() + 0.03
    assert np.abs(places[:, feet, 1] - wanted)[planted].max() < FOOT_M

    facing = [(pelvis @ [0.0, 0.0, 1.0])[:, [0, 2]] for pelvis in (rotations[:, 0], source.rotations[:, 0])]
    facing = [way / np.linalg.norm(way, axis=1, keepdims=True) for way in facing]
    assert (facing[0] * facing[1]).sum(1).min() > np.cos(np.radians(10))


@pytest.mark.parametrize("subject", [None, *BUILTIN_SUBJECTS])
def test_thighs_at_the_height_of_the_pelvis_do_not_turn_it_over(tmp_path, subject):
    source = rig_motion(builtin_motion("jumping_jacks", 3, duration_s=0.5), CONVENTIONS["xsens"])
    skeleton = None if subject is None else skeleton_of(subject)
    path = write_bvh(tmp_path / "walk.bvh", source.rig)
    pelvis = Rotation.from_rotvec(read_motion(path, skeleton).poses[:, 0]).as_matrix()
    assert angles_deg(pelvis, source.rotations[:, 0]).max() < 1


@pytest.mark.parametrize("degrees", [(0, 0, -90), (0, 0, 90), (180, 0, 0), (-90, 0, 0)], ids=["x", "-x", "-y", "-z"])
def test_other_up_axes_are_found_if_rest_and_clip_agree(degrees, caplog):
    source = rig_motion(motion_of("xsens"), CONVENTIONS["xsens"])
    skeleton = skeleton_of("50002")
    wanted = retarget_rig(source.rig, source.rig.clips[0], skeleton, path=Path("a.bvh"), name="a").motion
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    clip = replace(source.rig.clips[0], world_from_joint=world @ source.rig.clips[0].world_from_joint)
    rig = replace(source.rig, rest=world @ source.rig.rest, clips=(clip,))
    with caplog.at_level(logging.INFO, "snarfcli"):
        turned = retarget_rig(rig, clip, skeleton, path=Path("a.bvh"), name="a").motion
    assert "is up in this file and was turned to y" in caplog.text
    lean = Rotation.from_rotvec(turned.poses[:, 0]).apply([0, 1, 0]) - Rotation.from_rotvec(wanted.poses[:, 0]).apply([0, 1, 0])
    assert np.abs(lean[:, 1]).max() < 1e-6  # as upright, facing somewhere
    np.testing.assert_allclose(turned.translation[:, 1], wanted.translation[:, 1], atol=1e-6)


def test_a_guessed_rest_pose_is_said_and_can_be_chosen(tmp_path, caplog):
    source = rig_motion(motion_of("legs_along_x"), CONVENTIONS["legs_along_x"])
    skeleton = skeleton_of("50002")
    with caplog.at_level(logging.INFO, "snarfcli"):
        guessed = read(tmp_path, source, skeleton)
    assert "not that of a standing person (left leg, right leg)" in caplog.text
    assert "rest=file" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.INFO, "snarfcli"):
        taken = read(tmp_path, source, skeleton, rest="file")
    assert "standing person" not in caplog.text
    knees = [4, 5]
    assert angles_deg(posed(guessed, skeleton)[0][:, knees], source.rotations[:, knees]).max() < 15
    assert angles_deg(posed(taken, skeleton)[0][:, knees], source.rotations[:, knees]).max() > 60


def test_a_frame_of_the_clip_may_be_the_rest_pose(tmp_path):
    motion = motion_of("lafan_along_x_level")
    motion = Motion("a", np.concatenate([np.zeros((1, 24, 3)), motion.poses]), np.zeros((len(motion.poses) + 1, 3)), 30.0)
    source = rig_motion(motion, CONVENTIONS["lafan_along_x_level"])
    skeleton = skeleton_of("50002")
    rotations, _ = posed(read(tmp_path, source, skeleton, rest="0"), skeleton)
    assert angles_deg(rotations[:, :22], source.rotations[:, :22]).max() < 8  # what the bones of the two bodies differ
    for rest, message in (
        ("99", "wanted a frame from 0 to"),
        ("bind", "rest: wanted auto, file, clip or the number of a frame"),
    ):
        with pytest.raises(UserError, match=message):
            read(tmp_path, source, skeleton, rest=rest)


def test_rest_poses_of_standing_people_are_compared_with_the_clip_on_request(tmp_path):
    source = rig_motion(motion_of("mixamo_t"), CONVENTIONS["mixamo_t"])
    skeleton = skeleton_of("50002")
    rotations, _ = posed(read(tmp_path, source, skeleton, rest="clip"), skeleton)
    angles = angles_deg(rotations[:, :20], source.rotations[:, :20]).max()
    assert 1 < angles < 20


def test_a_skeleton_at_rest_along_one_axis_takes_its_own_motion(tmp_path):
    """Both rest poses are alike, so nothing has to be guessed."""
    source = rig_motion(motion_of("rokoko_along_x"), CONVENTIONS["rokoko_along_x"])
    rig: Rig = source.rig
    skeleton = skeleton_of("50002")
    own = type(skeleton)(rig.names, rig.parents, torch.from_numpy(rig.rest[:, :3, 3] / 100), torch.zeros(24, 3))
    motion = read(tmp_path, source, own, up="y")
    rotations, _ = posed(motion, own)
    np.testing.assert_allclose(rotations, rig.clips[0].world_from_joint[..., :3, :3], atol=1e-6)


def test_collars_grow_continuously_into_the_direction_of_the_rig(tmp_path):
    """A rig whose collar bones are raised by a little more at rest must not turn by much more."""
    motion = builtin_motion("jumping_jacks", 3, duration_s=0.2)
    skeleton = skeleton_of("50002")
    turns = []
    for raised_deg in np.arange(20, 60, 1.0):
        rig = rig_motion(motion, CONVENTIONS["mixamo_t"]).rig
        rest = rig.rest.copy()
        lift = np.array([0.0, 11 * np.tan(np.radians(raised_deg)), 0.0])
        for side in (16, 17):
            arm = [side, side + 2, side + 4, side + 6]
            rest[arm, :3, 3] += lift
        rig = Rig(rig.names, rig.parents, rest, rig.clips)
        poses = retarget_rig(rig, rig.clips[0], skeleton, path=tmp_path / "a.glb", name="a").motion.poses
        turns.append(Rotation.from_rotvec(poses[0, 13]).as_matrix())
    steps = angles_deg(np.stack(turns[:-1]), np.stack(turns[1:]))
    assert steps.max() < 4
    assert angles_deg(turns[0], turns[-1]) > 10
