"""Arrays of pose files in every layout, and a one-line error for each kind of damage."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from pose_files import TWO_JOINTS, amass_arrays, save
from scipy.spatial.transform import Rotation

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, builtin_body
from snarfcli.errors import UserError
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.layouts import SMPL, SMPL_H, SMPL_X


@pytest.mark.parametrize("width", [156, 165])
def test_long_poses_keep_the_body_and_straighten_the_hands(tmp_path, width):
    arrays = amass_arrays(width=width)
    motion = read_motion(save(tmp_path, **arrays), up="z")
    assert motion.name == "walk_poses"
    assert motion.frame_rate == 120.0
    assert motion.poses.shape == (4, 24, 3)
    np.testing.assert_array_equal(motion.poses[:, 1:22].reshape(4, -1), arrays["poses"][:, 3:66])
    np.testing.assert_array_equal(motion.poses[:, 22:], 0)


def test_z_up_becomes_y_up_for_body_and_way(tmp_path):
    arrays = amass_arrays()
    path = save(tmp_path, **arrays)
    turned, kept = read_motion(path), read_motion(path, up="y")
    body = builtin_body()
    before, after = (body.pose(motion.poses, translation=motion.translation).vertices for motion in (kept, turned))
    expected = np.stack([before[..., 0], before[..., 2], -before[..., 1]], -1)  # x stays, z goes up, y goes back
    # the pelvis at rest is where the reader takes it to be within 0.4 mm
    np.testing.assert_allclose(after, expected, rtol=0, atol=5e-4)
    up = Rotation.from_rotvec(turned.poses[:, 0]).apply([0.0, 1.0, 0.0])
    assert up[:, 1].min() > 0.8


def test_72_values_are_taken_as_they_are_without_a_translation(tmp_path):
    poses = amass_arrays(width=72)["poses"]
    motion = read_motion(save(tmp_path, poses=poses, mocap_frame_rate=np.array([30])))
    np.testing.assert_array_equal(motion.poses.reshape(4, 72), poses)
    np.testing.assert_array_equal(motion.translation, 0)
    assert motion.frame_rate == 30.0


def test_72_values_with_a_translation_are_judged_by_how_the_body_stands(tmp_path):
    arrays = amass_arrays(width=72)
    assert np.abs(read_motion(save(tmp_path, **arrays)).poses[:, 0]).max() < 0.6  # turned upright
    ours = builtin_motion("hips", 1).slice(0, 5)
    path = save(tmp_path, poses=ours.poses.reshape(5, 72), trans=ours.translation, mocap_framerate=60.0)
    back = read_motion(path)
    np.testing.assert_array_equal(back.poses, ours.poses)
    np.testing.assert_array_equal(back.translation, ours.translation)


@pytest.mark.parametrize("turn", [0.9, np.pi / 2])
def test_a_file_may_say_which_way_is_up(tmp_path, turn):
    """A body that leans or lies would mislead the guess."""
    poses = np.zeros((1, 72))
    poses[0, 0] = turn
    arrays = {"poses": poses, "trans": np.array([[0, 0.5, 0]]), "fps": 30.0}
    motion = read_motion(save(tmp_path, **arrays, up=np.array("y")))
    np.testing.assert_array_equal(motion.poses[0, 0], [turn, 0, 0])
    np.testing.assert_array_equal(motion.translation, [[0, 0.5, 0]])
    turned = read_motion(save(tmp_path, **arrays, up=np.array("z")))
    np.testing.assert_allclose(turned.poses[0, 0], [turn - np.pi / 2, 0, 0], atol=1e-12)
    with_nonsense = read_motion(save(tmp_path, **arrays, up=np.array("sideways")), up="y")
    np.testing.assert_array_equal(with_nonsense.poses[0, 0], [turn, 0, 0])


@pytest.mark.parametrize("gender", [np.array("male"), np.array(b"female"), np.bytes_("neutral"), "male", np.array(["x"]),
                                    np.array("male", object), np.array(open, object)])  # fmt: skip
def test_gender_may_be_anything(tmp_path, gender):
    assert read_motion(save(tmp_path, **{**amass_arrays(), "gender": gender})).num_frames == 4


def test_single_pose_and_joint_axis(tmp_path):
    assert read_motion(save(tmp_path, poses=np.zeros(72))).poses.shape == (1, 24, 3)
    assert read_motion(save(tmp_path, poses=np.zeros((5, 24, 3), np.float32))).poses.shape == (5, 24, 3)
    assert read_motion(save(tmp_path, poses=np.zeros((24, 3)))).poses.shape == (1, 24, 3)
    assert read_motion(save(tmp_path, poses=np.zeros((5, 6))), TWO_JOINTS).poses.shape == (5, 2, 3)
    assert read_motion(save(tmp_path, poses=np.zeros((5, 2, 3))), TWO_JOINTS).poses.shape == (5, 2, 3)


def test_missing_frame_rate_is_noted(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "snarfcli"):
        motion = read_motion(save(tmp_path, poses=np.zeros((2, 72))))
    assert motion.frame_rate == 60.0
    assert "no frame rate given, 60 frames per second assumed" in caplog.text


def one_absurd_value():
    poses = np.zeros((5, 72))
    poses[2, 7] = 1e8
    return poses


def nan_poses():
    poses = np.zeros((3, 72))
    poses[1, 5] = np.nan
    return poses


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"trans": np.zeros((2, 3))}, "wanted 'poses', got trans"),
        ({"v": np.zeros((2, 3))}, "wanted 'poses', got v; give a file with poses"),
        (
            {"poses": np.degrees(amass_arrays(width=72)["poses"])},
            "got degrees, up to .*save them in radians",
        ),
        ({"poses": np.full((3, 72), 1e300)}, "wanted angles in radians, got degrees"),
        ({"poses": one_absurd_value()}, r"wanted angles in radians, got 1e\+08"),
        ({"poses": np.zeros((2, 24, 3, 3))}, r"poses: wanted rotation matrices, got others of shape \[2, 24, 3, 3\]"),
        ({"poses": np.zeros((2, 24, 4))}, r"poses: wanted shape \[frames, values\], got \[2, 24, 4\]"),
        ({"poses": np.zeros((2, 69))}, "values per frame, got 69"),
        ({"poses": np.zeros((2, 72), complex)}, "poses: wanted numbers, got complex128"),
        ({"root_orient": np.zeros((2, 3))}, "wanted 'poses', got root_orient"),
        (
            {"root_orient": np.zeros((2, 3)), "pose_body": np.zeros((3, 63))},
            r"wanted shape \[2, 63\], got \[3, 63\]",
        ),
        ({"poses": np.zeros((2, 72)), "trans": np.full((2, 3), 1e9)}, "trans: wanted metres, at most 1000 km, got more"),
        (
            {"poses": np.zeros((2, 72)), "smpl_scaling": 0.0, "trans": np.ones((2, 3))},
            "wanted one positive number",
        ),
        ({"poses": np.zeros((4, 71))}, r"wanted 72 \(SMPL\), 156 \(SMPL-H\) or 165 \(SMPL-X\) values per frame, got 71"),
        ({"poses": nan_poses()}, "poses: wanted finite numbers, got NaN or infinity, first in frame 1"),
        ({"poses": np.full((2, 72), np.inf)}, "poses: wanted finite numbers, got NaN or infinity, first in frame 0"),
        ({"poses": np.zeros((0, 72))}, "wanted at least 1 frame, got 0"),
        ({"poses": np.zeros((0, 24, 3))}, "wanted at least 1 frame, got 0"),
        ({"poses": np.zeros((2, 2, 2, 72))}, r"poses: wanted shape \[frames, values\], got \[2, 2, 72\]"),
        ({"poses": np.array("walk")}, "poses: wanted numbers, got <U4"),
        ({"poses": np.array([{"a": 1}], dtype=object)}, "wanted 'poses', got a, poses"),
        ({"poses": np.array(open, dtype=object)}, "poses: wanted an array, got an object of .*open; nothing was executed"),
        ({"poses": np.zeros((4, 72)), "trans": np.zeros((3, 3))}, r"trans: wanted shape \[4, 3\], got \[3, 3\]"),
        ({"poses": np.zeros((4, 72)), "trans": np.zeros(4)}, r"trans: wanted shape \[4, 3\], got \[1, 4\]"),
        ({"poses": np.zeros((1, 72)), "trans": np.full((1, 3), np.nan)}, "trans: wanted finite numbers, got NaN or infinity"),
        ({"poses": np.zeros((1, 72)), "mocap_framerate": np.array(0.0)}, "mocap_framerate: wanted one positive number"),
        ({"poses": np.zeros((1, 72)), "mocap_frame_rate": np.array("fast")}, "mocap_frame_rate: wanted one positive number"),
    ],
)
def test_bad_content(tmp_path, arrays, message):
    path = save(tmp_path, **arrays)
    with pytest.raises(UserError, match=message) as caught:
        read_motion(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def smpl_like(names):
    parents = (-1, *(max(0, j // 2) for j in range(1, len(names))))  # any tree: only names count
    return Skeleton(tuple(names), parents, torch.zeros(len(names), 3), torch.zeros(len(names), 3))


def test_joints_are_carried_over_by_name(tmp_path):
    rng = np.random.default_rng(0)
    given = {72: SMPL, 156: SMPL_H, 165: SMPL_X}
    values = {width: 0.3 * rng.normal(size=(3, width)) for width in given}
    targets = {**{len(names): smpl_like(names) for names in given.values()}}
    spelt = smpl_like([name.replace("l_", "left_").replace("r_", "right_") for name in SMPL_X])
    nameless = smpl_like([f"joint_{j}" for j in range(52)])
    for width, names in given.items():
        path = save(tmp_path, poses=values[width])
        for skeleton in (*targets.values(), spelt, nameless):
            wanted = {24: SMPL, 52: SMPL_H, 55: SMPL_X}[skeleton.num_joints]
            poses = read_motion(path, skeleton, up="y").poses
            for joint, name in enumerate(wanted):
                expected = values[width].reshape(3, -1, 3)[:, names.index(name)] if name in names else np.zeros((3, 3))
                np.testing.assert_array_equal(poses[:, joint], expected)


@pytest.mark.parametrize(("width", "first"), [(156, 66), (165, 75)])
def test_released_hands_are_two_joints_of_the_left_index_finger(tmp_path, width, first):
    arrays = amass_arrays(width=width)
    motion = read_motion(save(tmp_path, **arrays), up="y", hands="released")
    np.testing.assert_array_equal(motion.poses.reshape(4, 72)[:, 66:], arrays["poses"][:, first : first + 6])
    np.testing.assert_array_equal(motion.poses.reshape(4, 72)[:, :66], arrays["poses"][:, :66])


def test_a_skeleton_of_another_kind_takes_its_own_width_only(tmp_path):
    own = smpl_like([f"bone{j}" for j in range(52)])
    path = save(tmp_path, **amass_arrays())
    np.testing.assert_array_equal(read_motion(path, own, up="y").poses.reshape(4, 156), amass_arrays()["poses"])
    with pytest.raises(UserError, match=r"wanted 156 values per frame, got 165"):
        read_motion(save(tmp_path, **amass_arrays(width=165)), own)


def test_someone_spinning_is_not_in_degrees(tmp_path):
    poses = np.zeros((100, 72))
    poses[:, 1] = np.linspace(0, 60, 100)  # ten turns, never wrapped
    assert read_motion(save(tmp_path, poses=poses)).num_frames == 100


def test_default_skeleton_is_smpl(tmp_path):
    assert SMPL == SMPL_JOINT_NAMES
    assert len(SMPL_H) == 52
    assert len(SMPL_X) == 55
    assert SMPL_H[22] == "l_index1"
    assert SMPL_H[37] == "r_index1"
    assert SMPL_X[22:26] == ("jaw", "l_eye", "r_eye", "l_index1")
