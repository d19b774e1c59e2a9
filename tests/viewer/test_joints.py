from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_avatar import LENGTH, ToyAvatar

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.motions import read_motion
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS
from snarfcli.viewer.joints import (
    ANGLE_LIMITS_DEG,
    angles_of,
    global_turns,
    joint_labels,
    mirrored_joint,
    pose_file,
    posed_joints,
    vector_from_turn,
    vector_of,
)


@pytest.fixture(scope="module")
def person() -> Skeleton:
    rest = torch.from_numpy(JOINTS_REST).float()
    return Skeleton(SMPL_JOINT_NAMES, PARENTS, rest, legs_apart_pose(SMPL_JOINT_NAMES))


def transforms_of(skeleton: Skeleton, pose: np.ndarray) -> np.ndarray:
    return skeleton.posed_from_canonical(torch.from_numpy(pose).float()[None])[0].numpy()


def test_joints_are_listed_limb_by_limb(person):
    labels = joint_labels(person)
    assert sorted(labels.values()) == list(range(1, 24))
    limbs = list(dict.fromkeys(label.split(":")[0] for label in labels))
    assert limbs == ["trunk", "head", "left arm", "right arm", "left leg", "right leg"]
    assert labels["left arm: elbow"] == 18
    assert labels["right leg: knee"] == 5
    assert labels["trunk: spine3"] == 9


def test_joints_that_are_no_part_of_a_person_keep_their_names():
    assert joint_labels(ToyAvatar().skeleton) == {"joint_1": 1}
    twins = Skeleton(("root", "Tail", "Tail"), (-1, 0, 1), torch.zeros(3, 3), torch.zeros(3, 3))
    assert list(joint_labels(twins).values()) == [1, 2]
    hostile = Skeleton(("root", "\x1b[2J\n" + "x" * 10**5, ""), (-1, 0, 1), torch.zeros(3, 3), torch.zeros(3, 3))
    assert joint_labels(hostile) == {"[2J " + "x" * 56: 1, "joint 2": 2}
    assert joint_labels(Skeleton(("root",), (-1,), torch.zeros(1, 3), torch.zeros(1, 3))) == {}


def test_every_rotation_has_angles_within_the_limits():
    for turn in Rotation.random(200, random_state=0):
        angles = np.array(angles_of(turn.as_rotvec()))
        assert (np.abs(angles) <= np.array(ANGLE_LIMITS_DEG) + 1e-6).all()
        assert (Rotation.from_rotvec(vector_of(angles)).inv() * turn).magnitude() < 1e-6
    assert angles_of(np.zeros(3)) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(vector_of((0, 90, 0)), (0, np.pi / 2, 0))
    assert np.isfinite(angles_of(vector_of((20, 90, 30)))).all()  # where x and z turn about the same axis


def test_a_mirrored_joint_mirrors_the_body(person):
    pose = np.zeros((24, 3))
    pose[16], pose[18] = (0.3, -0.5, 0.8), (0.1, 1.2, -0.2)
    mirrored = np.zeros((24, 3))
    for joint in (16, 18):
        other, vector = mirrored_joint(person, joint, pose[joint])
        mirrored[other] = vector
    swapped = posed_joints(person, transforms_of(person, mirrored))[list(person.left_right)]
    np.testing.assert_allclose(swapped * (-1, 1, 1), posed_joints(person, transforms_of(person, pose)), atol=1e-5)


def test_posed_joints_are_those_of_the_avatar():
    skeleton = ToyAvatar(3).skeleton
    pose = np.zeros((3, 3))
    pose[1, 2] = np.pi / 2
    joints = posed_joints(skeleton, transforms_of(skeleton, pose))
    np.testing.assert_allclose(joints, [(0, 0, 0), (LENGTH, 0, 0), (LENGTH, LENGTH, 0)], atol=1e-6)


def test_a_turned_handle_gives_the_joints_own_rotation(person):
    pose = 0.4 * np.random.default_rng(0).standard_normal((24, 3))
    transforms = transforms_of(person, pose)
    turns = global_turns(person, transforms)
    for joint in (0, 4, 18):
        np.testing.assert_allclose(vector_from_turn(person, transforms, joint, turns[joint]), pose[joint], atol=1e-5)


def test_a_saved_pose_is_read_again(person, tmp_path):
    pose = 0.2 * np.random.default_rng(1).standard_normal((24, 3))
    path = tmp_path / "pose.npz"
    path.write_bytes(pose_file(pose, np.array([0.1, 1.0, -0.3])))
    motion = read_motion(path, person, up="y")
    np.testing.assert_allclose(motion.poses[0], pose, atol=1e-6)
    np.testing.assert_allclose(motion.translation, [(0.1, 1.0, -0.3)], atol=1e-6)


@pytest.mark.parametrize("lean", [0.9, np.pi / 2])
def test_a_saved_pose_that_leans_or_lies_is_read_again_as_it_is(person, tmp_path, lean):
    pose = np.zeros((24, 3))
    pose[0, 0], pose[18] = lean, (0, 0, 1)
    path = tmp_path / "pose.npz"
    path.write_bytes(pose_file(pose, np.array([0, 0.5, 0])))
    motion = read_motion(path, person)  # up=auto, as the commands have it
    np.testing.assert_allclose(motion.poses[0], pose, atol=1e-6)
    np.testing.assert_allclose(motion.translation, [(0, 0.5, 0)], atol=1e-6)
