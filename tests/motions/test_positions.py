"""Joint positions in the shape of pose arrays are refused; rotations never are."""

from __future__ import annotations

import numpy as np
import pytest
from pose_files import amass_arrays, save
from scipy.spatial.transform import Rotation

from snarfcli.bodies import builtin_body
from snarfcli.errors import UserError
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, builtin_motion, read_motion
from snarfcli.motions.anatomy import joint_positions
from snarfcli.motions.positions import are_positions

NAMES = (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES)


def positions(name="punching", frames=20, *, at_root=False):
    motion = builtin_motion(name, 1, frame_rate=30).slice(0, frames)
    joints = joint_positions(motion.poses, motion.translation)[0]
    return joints - joints[:, :1] if at_root else joints


def refusal(path):
    with pytest.raises(UserError, match=r"wanted rotations, got joint positions: .* fit SMPL to the positions first") as caught:
        read_motion(path)
    return str(caught.value)


@pytest.mark.parametrize("name", ["punching", "deep_squats", "bridges"])
@pytest.mark.parametrize("at_root", [False, True])
def test_positions_of_any_count_unit_frame_and_shape(tmp_path, name, at_root):
    joints = positions(name, at_root=at_root)
    fingers = np.tile(joints[:, 20:21], (1, 31, 1)) + np.linspace(0, 0.1, 31)[:, None]
    for values in (
        joints[:, :22],
        joints,
        joints.reshape(20, 72),
        1000 * joints,
        joints @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T,
        joints[:1],
        joints[3, :22].ravel(),
        np.tile(joints[:1], (5, 1, 1)),
        np.concatenate([joints[:, :22], fingers[:, :30]], 1).astype(np.float32),
        np.concatenate([joints, fingers], 1),
    ):
        assert "poses: " in refusal(save(tmp_path, poses=values))
    np.save(tmp_path / "joints.npy", joints)
    assert "joints.npy: poses" in refusal(tmp_path / "joints.npy")


def test_positions_in_another_order_are_known_by_their_distances():
    rng = np.random.default_rng(0)
    for name in ("punching", "knees", "lunges"):
        values = positions(name, 60)[:, rng.permutation(24)]
        assert are_positions(values)
        assert are_positions(100 * values)
        assert are_positions(values.astype(np.float32).astype(np.float64))


def test_positions_with_noise_are_known_by_their_proportions():
    values = positions() + 0.015 * np.random.default_rng(0).normal(size=(20, 24, 3))
    assert are_positions(values)
    assert are_positions(values[:1] * 0.6)  # a child


def test_positions_of_the_body_are_known():
    motion = builtin_motion("hips", 0, frame_rate=30).slice(0, 10)
    assert are_positions(builtin_body().pose(motion.poses, translation=motion.translation).joints.numpy())


@pytest.mark.parametrize("name", NAMES)
def test_no_piece_of_a_motion_is_refused(name):
    poses = builtin_motion(name, 0, frame_rate=30).poses
    turned = poses.copy()
    turned[:, 0] = (Rotation.from_euler("x", 90, degrees=True) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    for values in (poses, turned):
        pieces = [values, values[:1], *(values[start : start + 12] for start in range(0, len(values), 12))]
        assert not any(are_positions(piece) for piece in pieces)


def test_no_still_random_or_circling_pose_is_refused(tmp_path):
    rng = np.random.default_rng(1)
    still = np.zeros((30, 24, 3))
    assert not are_positions(still)
    still[:, 5] = 1.0
    assert not are_positions(still)
    for scale in (0.01, 0.1, 0.3, 1.0, 3.0):
        for joints in (22, 24, 52, 55):
            for frames in (1, 8, 40):
                assert not are_positions(scale * rng.normal(size=(frames, joints, 3)))
    # Limbs that circle at a constant angle keep their distance to all joints at rest.
    turn = np.linspace(0, 6, 40)
    circle = np.stack([np.zeros(40), np.cos(turn), np.sin(turn)], 1)
    for moving in ((0,), (16, 17), (1, 2, 16, 17)):
        poses = np.zeros((40, 24, 3))
        poses[:, moving] = 0.5 * circle[:, None]
        assert not are_positions(poses)
    assert read_motion(save(tmp_path, **amass_arrays())).num_frames == 4
    assert not are_positions(np.zeros((0, 24, 3)))
    assert not are_positions(np.zeros((2, 0, 3)))
    assert not are_positions(np.full((9, 24, 3), 1e300))
