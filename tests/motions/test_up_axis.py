"""The up axis: every axis can be named, and a body that hangs head down during a whole clip is turned over."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from estimates import camera_poses
from pose_files import save
from scipy.spatial.transform import Rotation
from toy_rigs import MIXAMO_NAMES, rig_of, write_bvh

from snarfcli.bodies import builtin_body
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.up_axis import UPS, hangs_head_down, y_from_up

OURS = builtin_motion("hips", 1, frame_rate=30.0).slice(0, 10)
AXES = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0], "-z": [0, 0, -1]}
MESSAGE = "the body hangs head down along y, so that y was taken to point down; up=y keeps it"


def turned(poses, rotation):
    poses = poses.copy()
    poses[:, 0] = (rotation * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses


def heights(motion):
    return Rotation.from_rotvec(motion.poses[:, 0]).apply([0.0, 1.0, 0.0])[:, 1]


@pytest.mark.parametrize("up", AXES)
def test_every_axis_can_be_named(tmp_path, up):
    np.testing.assert_allclose(y_from_up(up).apply(AXES[up]), [0, 1, 0], atol=1e-12)
    assert up in UPS
    there = y_from_up(up).inv()
    path = save(tmp_path, poses=turned(OURS.poses, there).reshape(10, 72), trans=OURS.translation, fps=30.0)
    motion = read_motion(path, up=up)
    np.testing.assert_allclose(motion.poses, OURS.poses, atol=1e-9)
    body = builtin_body()
    before, after = (
        body.pose(each.poses, translation=each.translation).vertices for each in (read_motion(path, up="y"), motion)
    )
    # the pelvis at rest is where the reader takes it to be within 0.4 mm
    np.testing.assert_allclose(after, before.numpy() @ y_from_up(up).as_matrix().T, rtol=0, atol=1e-3)
    declared = read_motion(save(tmp_path, poses=turned(OURS.poses, there).reshape(10, 72), up=np.array(up)))
    np.testing.assert_allclose(declared.poses, OURS.poses, atol=1e-9)


@pytest.mark.parametrize("up", ["-y", "x", "-z"])
def test_rigs_take_every_axis_too(tmp_path, up):
    rig = rig_of(turned(OURS.poses, y_from_up(up).inv()), np.zeros((10, 3)), MIXAMO_NAMES)
    motion = read_motion(write_bvh(tmp_path / "a.bvh", rig), up=up)
    assert heights(motion).min() > 0.9


@pytest.mark.parametrize("keys", [{}, {"trans": OURS.translation}, {"cam_trans": OURS.translation}])
def test_a_camera_with_y_down_is_recognised_by_the_body(tmp_path, caplog, keys):
    path = save(tmp_path, poses=camera_poses(OURS.poses).reshape(10, 72), **keys)
    with caplog.at_level(logging.INFO, "snarfcli"):
        motion = read_motion(path)
    np.testing.assert_allclose(motion.poses, OURS.poses, atol=1e-9)
    assert MESSAGE in caplog.text
    assert heights(read_motion(path, up="y")).max() < -0.9


def test_bodies_of_a_camera_may_bend_and_lie_down(tmp_path):
    """Names of a camera's arrays are a sign of their own: then the average decides, and z is no candidate."""
    bent = builtin_motion("bridges", 0, frame_rate=30.0).poses
    path = save(tmp_path, poses=camera_poses(bent).reshape(len(bent), 72), pred_cam_t=np.zeros((len(bent), 3)))
    np.testing.assert_allclose(read_motion(path).poses[:, 1:], bent[:, 1:])
    lying = turned(OURS.poses, Rotation.from_euler("x", 80, degrees=True))
    path = save(tmp_path, poses=camera_poses(lying).reshape(10, 72), pred_cam_t=np.zeros((10, 3)))
    np.testing.assert_allclose(read_motion(path).poses, lying, atol=1e-9)


def spin(share):
    """Return 60 frames that stand and, during a share of them, turn over and back."""
    angles = np.zeros(60)
    count = round(60 * share)
    angles[:count] = np.pi
    return turned(np.tile(OURS.poses[:1], (60, 1, 1)), Rotation.from_rotvec(np.stack([angles, 0 * angles, 0 * angles], 1)))


def test_somersaults_and_handstands_are_not_turned_over(tmp_path):
    roll = np.stack([np.linspace(0, 2 * np.pi, 60), np.zeros(60), np.zeros(60)], 1)
    somersault = turned(np.tile(OURS.poses[:1], (60, 1, 1)), Rotation.from_rotvec(roll))
    cartwheel = turned(np.tile(OURS.poses[:1], (60, 1, 1)), Rotation.from_rotvec(roll[:, [1, 2, 0]]))
    for poses in (somersault, cartwheel, spin(0.3), spin(0.6), spin(0.9)):
        motion = read_motion(save(tmp_path, poses=poses.reshape(60, 72), trans=np.ones((60, 3))))
        np.testing.assert_array_equal(motion.poses, poses)
    assert hangs_head_down(spin(0.97), is_likely=False)
    assert hangs_head_down(spin(0.6), is_likely=True)
    # bent double: the head is below the pelvis, and the feet are below the head all the same
    bent = np.zeros((10, 24, 3))
    bent[:, [1, 2], 0] = -1.7
    bent[:, 0, 0] = 1.7
    assert not hangs_head_down(bent, is_likely=True)


def test_files_of_amass_and_aist_keep_their_axis(tmp_path):
    """Someone who lies head first along -y in a world with z up is no sign of a camera."""
    poses = np.zeros((8, 156))
    poses[:, :72] = camera_poses(OURS.poses[:8]).reshape(8, 72)
    motion = read_motion(save(tmp_path, poses=poses, trans=np.zeros((8, 3))))
    np.testing.assert_allclose(motion.poses[:, 0], turned(camera_poses(OURS.poses[:8]), y_from_up("z"))[:, 0], atol=1e-9)
    seen = camera_poses(OURS.poses[:8])
    np.testing.assert_array_equal(read_motion(save(tmp_path, smpl_poses=seen.reshape(8, 72))).poses, seen)
