"""Reading AMASS-style files: what is taken from a good one, and one line for each kind of bad one."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snarfcli.bodies import builtin_body
from snarfcli.errors import UserError
from snarfcli.motions import builtin_motion, read_motion

UPRIGHT_IN_Z_UP = np.array([np.pi / 2, 0, 0])  # turns the y-up rest body to stand along z


def amass_arrays(frames=4, width=156, seed=0):
    rng = np.random.default_rng(seed)
    poses = 0.3 * rng.normal(size=(frames, width))
    poses[:, :3] = UPRIGHT_IN_Z_UP + 0.1 * rng.normal(size=(frames, 3))
    trans = rng.normal(size=(frames, 3))
    return {
        "poses": poses,
        "trans": trans,
        "mocap_framerate": np.array(120.0),
        "gender": np.array("neutral"),
        "betas": np.zeros(16),
    }


def save(tmp_path, **arrays):
    path = tmp_path / "walk_poses.npz"
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


@pytest.mark.parametrize("width", [156, 165])
def test_long_poses_keep_the_body_and_straighten_the_hands(tmp_path, width):
    arrays = amass_arrays(width=width)
    motion = read_motion(save(tmp_path, **arrays), up="z")
    assert motion.name == "walk_poses" and motion.frame_rate == 120.0 and motion.poses.shape == (4, 24, 3)
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


@pytest.mark.parametrize("gender", [np.array("male"), np.array(b"female"), np.bytes_("neutral"), "male", np.array(["x"])])
def test_gender_may_be_anything(tmp_path, gender):
    assert read_motion(save(tmp_path, **{**amass_arrays(), "gender": gender})).num_frames == 4


def test_single_pose_and_joint_axis(tmp_path):
    assert read_motion(save(tmp_path, poses=np.zeros(72))).poses.shape == (1, 24, 3)
    assert read_motion(save(tmp_path, poses=np.zeros((5, 24, 3), np.float32))).poses.shape == (5, 24, 3)
    assert read_motion(save(tmp_path, poses=np.zeros((5, 6))), num_joints=2).poses.shape == (5, 2, 3)


def test_missing_frame_rate_is_noted(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "snarfcli"):
        motion = read_motion(save(tmp_path, poses=np.zeros((2, 72))))
    assert motion.frame_rate == 60.0 and "no frame rate given, 60 frames a second assumed" in caplog.text


def nan_poses():
    poses = np.zeros((3, 72))
    poses[1, 5] = np.nan
    return poses


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"trans": np.zeros((2, 3))}, "has no 'poses'; it holds trans"),
        ({"poses": np.zeros((4, 71))}, r"has 71 values a frame, wanted 72 \(SMPL\), 156 \(SMPL-H\) or 165 \(SMPL-X\)"),
        ({"poses": nan_poses()}, "poses holds NaN or infinity, first in frame 1"),
        ({"poses": np.full((2, 72), np.inf)}, "poses holds NaN or infinity, first in frame 0"),
        ({"poses": np.zeros((0, 72))}, "has zero frames"),
        ({"poses": np.zeros((0, 24, 3))}, "has zero frames"),
        ({"poses": np.zeros((2, 2, 72))}, r"poses has shape \[2, 2, 72\], wanted \[frames, values\]"),
        ({"poses": np.array("walk")}, "poses holds <U4, wanted numbers"),
        ({"poses": np.array([{"a": 1}], dtype=object)}, "holds pickled objects, which are never executed"),
        ({"poses": np.zeros((2, 72)), "gender": np.array(None, dtype=object)}, "holds pickled objects"),
        ({"poses": np.zeros((4, 72)), "trans": np.zeros((3, 3))}, r"trans has shape \[3, 3\], wanted \[4, 3\]"),
        ({"poses": np.zeros((4, 72)), "trans": np.zeros(4)}, r"trans has shape \[1, 4\], wanted \[4, 3\]"),
        ({"poses": np.zeros((1, 72)), "trans": np.full((1, 3), np.nan)}, "trans holds NaN or infinity"),
        ({"poses": np.zeros((1, 72)), "mocap_framerate": np.array(0.0)}, "mocap_framerate must be one positive number"),
        ({"poses": np.zeros((1, 72)), "mocap_frame_rate": np.array("fast")}, "mocap_frame_rate must be one positive number"),
    ],
)
def test_bad_content(tmp_path, arrays, message):
    path = save(tmp_path, **arrays)
    with pytest.raises(UserError, match=message) as caught:
        read_motion(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_bad_files(tmp_path):
    path = save(tmp_path, **amass_arrays(frames=50))
    content = path.read_bytes()
    for name, written, message in (
        ("truncated", content[: len(content) // 2], "truncated"),
        ("text", b"poses, trans\n", "not an .npz archive"),
        ("empty", b"", "not an .npz archive"),
        ("flipped", content[:900] + bytes(400) + content[1300:], "cannot be read|damaged"),
    ):
        broken = tmp_path / f"{name}.npz"
        broken.write_bytes(written)
        with pytest.raises(UserError, match=message) as caught:
            read_motion(broken)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no pose file at"):
        read_motion(tmp_path / "none.npz")
    with pytest.raises(UserError, match="is a folder"):
        read_motion(tmp_path)


def test_wrong_arguments(tmp_path):
    with pytest.raises(ValueError, match="up: wanted 'auto', 'y' or 'z', got 'x'"):
        read_motion(tmp_path / "a.npz", up="x")
    with pytest.raises(UserError, match="has 72 values a frame, wanted 6$"):
        read_motion(save(tmp_path, poses=np.zeros((1, 72))), num_joints=2)
