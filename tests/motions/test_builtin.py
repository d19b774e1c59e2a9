"""The built-in motions: inside the limits of human joints, at human speeds, on the floor, the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.errors import UserError
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, builtin_motion
from snarfcli.motions.anatomy import JOINTS_REST, LIMITS_DEG, joint_positions, poses_from_angles
from snarfcli.motions.extremes import EXTREMES, POSES
from snarfcli.motions.footing import FLOOR_Y

ALL = (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES)
JOINT = {name: number for number, name in enumerate(SMPL_JOINT_NAMES)}
SEEDS = (50002, 50021)

# Degrees per second, worst of ten subjects: 930 (the elbow of a punch) and 466 (the shoulder, arms back to overhead).
FASTEST = {"exercise": 1200, "extreme": 600}


@pytest.fixture(scope="module")
def motions():
    return {(name, seed): builtin_motion(name, seed) for name in ALL for seed in SEEDS}


def degrees(motion, name):
    return np.degrees(motion.poses[:, JOINT[name]])


@pytest.mark.parametrize("name", ALL)
def test_joints_stay_inside_human_limits(motions, name):
    for seed in SEEDS:
        motion = motions[name, seed]
        assert np.isfinite(motion.poses).all()
        assert np.isfinite(motion.translation).all()
        for side, sign in (("l", 1), ("r", -1)):
            knee = degrees(motion, f"{side}_knee")
            assert knee[:, 0].min() > -1
            assert knee[:, 0].max() < 146
            np.testing.assert_allclose(knee[:, 1:], 0, atol=1e-6)
            elbow = Rotation.from_rotvec(motion.poses[:, JOINT[f"{side}_elbow"]]).as_euler("YXZ", degrees=True)
            assert (-sign * elbow[:, 0]).min() > -1
            assert (-sign * elbow[:, 0]).max() < 151
            assert np.abs(elbow[:, 1]).max() < 0.45 * 85 + 1e-6
            assert np.abs(elbow[:, 2]).max() < 1e-6
            thigh = Rotation.from_rotvec(motion.poses[:, JOINT[f"{side}_hip"]]).apply([0.0, -1.0, 0.0])
            flexion = np.degrees(np.arctan2(thigh[:, 2], -thigh[:, 1]))
            assert flexion.min() > -50
            assert np.degrees(np.arccos(-thigh[:, 1])).max() < 135
            for joint, most in (("wrist", 85), ("hand", 80), ("ankle", 60), ("foot", 60), ("collar", 45), ("shoulder", 175)):
                assert np.linalg.norm(degrees(motion, f"{side}_{joint}"), axis=1).max() < most, (side, joint)
        trunk = sum(np.linalg.norm(degrees(motion, f"spine{number}"), axis=1) for number in (1, 2, 3))
        assert trunk.max() < 85
        assert sum(np.linalg.norm(degrees(motion, joint), axis=1) for joint in ("neck", "head")).max() < 90


@pytest.mark.parametrize("name", ALL)
def test_speeds_are_human(motions, name):
    fastest = FASTEST["exercise" if name in TRAINING_SEQUENCES else "extreme"]
    for seed in SEEDS:
        motion = motions[name, seed]
        rotations = [Rotation.from_rotvec(frames.reshape(-1, 3)) for frames in (motion.poses[:-1], motion.poses[1:])]
        speed = np.degrees((rotations[0].inv() * rotations[1]).magnitude()) * motion.frame_rate
        assert speed.max() < fastest
        assert np.sqrt(np.mean(speed**2)) > 20  # every subject keeps moving
        moved = np.abs(np.diff(motion.translation, axis=0)).max() * motion.frame_rate
        assert moved < 3.0  # metres per second


@pytest.mark.parametrize("name", ["chicken_wings", "hips", "punching", "shake_arms", "shake_hips", "shake_shoulders"])
def test_standing_feet_stay_where_they_are(motions, name):
    for seed in SEEDS:
        motion = motions[name, seed]
        positions, rotations = joint_positions(motion.poses, motion.translation)
        for side in "lr":
            ball = positions[:, JOINT[f"{side}_foot"]]
            assert np.ptp(ball, axis=0).max() < 0.006
            assert np.abs(ball[:, 1] - JOINTS_REST[10, 1]).max() < 0.006
            sole = rotations[:, JOINT[f"{side}_ankle"], 1, 1]
            assert sole.min() > np.cos(np.radians(2))


@pytest.mark.parametrize("name", ALL)
def test_the_floor_is_never_crossed(motions, name):
    for seed in SEEDS:
        motion = motions[name, seed]
        positions, _ = joint_positions(motion.poses, motion.translation)
        height = positions[:, :, 1].min(1) - FLOOR_Y
        assert height.min() > -0.02
        assert height.max() < 0.30  # a hop at most
        assert height.min() < 0.09  # and someone comes down again
        assert np.abs(motion.translation).max() < 1.5


def test_root_faces_forwards_and_stands_up(motions):
    for name in TRAINING_SEQUENCES:
        turn = Rotation.from_rotvec(motions[name, SEEDS[0]].poses[:, 0])
        assert turn.apply([0.0, 0.0, 1.0])[:, 2].min() > 0.8
        assert turn.apply([0.0, 1.0, 0.0])[:, 1].min() > 0.9


def test_hopping_leaves_the_ground_and_standing_does_not(motions):
    feet = [JOINT[name] for name in ("l_foot", "r_foot")]
    for name, leaves in (("light_hopping_stiff", True), ("jumping_jacks", True), ("hips", False), ("punching", False)):
        motion = motions[name, SEEDS[0]]
        lowest = joint_positions(motion.poses, motion.translation)[0][:, feet, 1].min(1)
        assert (np.ptp(lowest) > 0.015) == leaves


def test_same_seed_same_motion_other_seed_other_motion(motions):
    for name in ALL:
        first, again = motions[name, SEEDS[0]], builtin_motion(name, SEEDS[0])
        assert np.array_equal(first.poses, again.poses)
        assert np.array_equal(first.translation, again.translation)
        assert np.sqrt(np.mean((first.poses - motions[name, SEEDS[1]].poses) ** 2)) > 0.02  # radians


def test_frame_rate_only_chooses_the_moments():
    fast, slow = builtin_motion("punching", 3, frame_rate=60.0), builtin_motion("punching", 3, frame_rate=20.0)
    assert slow.num_frames * 3 == fast.num_frames
    np.testing.assert_allclose(fast.poses[::3], slow.poses, atol=1e-9)
    assert builtin_motion("hips", duration_s=0.5).num_frames == 30


def test_extremes_lie_outside_the_exercises(motions):
    def most(names, joint):
        return max(np.linalg.norm(degrees(motions[name, SEEDS[0]], joint), axis=1).max() for name in names)

    for joint, factor in (("l_hip", 1.2), ("spine1", 1.5), ("l_shoulder", 1.3)):
        assert most(OUT_OF_DISTRIBUTION_SEQUENCES, joint) > factor * most(TRAINING_SEQUENCES, joint)


def test_key_poses_are_inside_the_limits_and_used():
    used = {key.lstrip("-") for keys in EXTREMES.values() for key in keys}
    assert used <= set(POSES)
    for name, pose in POSES.items():
        for angle, value in pose.items():
            low, high = LIMITS_DEG[angle]
            assert low <= value <= high, (name, angle)


def test_mirrored_angles_give_a_mirrored_pose():
    rng = np.random.default_rng(0)
    sides = ("hip_flex", "hip_abd", "hip_rot", "knee", "ankle", "toe", "shrug", "protract", "arm_flex", "arm_abd")
    sides += ("arm_roll", "elbow", "pron", "wrist_flex", "wrist_dev", "curl")
    left = {f"l_{name}": rng.uniform(*np.divide(LIMITS_DEG[f"l_{name}"], 2), 1) for name in sides}
    middle = {"pelvis_turn": np.array([20.0]), "spine_bend": np.array([15.0]), "head_tilt": np.array([-9.0])}
    right = {"r" + name[1:]: value for name, value in left.items()}
    one = joint_positions(poses_from_angles({**left, **middle}, 1))[0][0]
    other = joint_positions(poses_from_angles({**right, **{name: -value for name, value in middle.items()}}, 1))[0][0]
    swap = [JOINT[{"l_": "r_", "r_": "l_"}.get(name[:2], name[:2]) + name[2:]] for name in SMPL_JOINT_NAMES]
    np.testing.assert_allclose(other[swap] * [-1, 1, 1], one, atol=1e-12)


def test_angles_mean_what_they_say():
    def joints(**angles):
        pose = poses_from_angles({name: np.array([float(value)]) for name, value in angles.items()}, 1)
        return dict(zip(SMPL_JOINT_NAMES, joint_positions(pose)[0][0], strict=True))

    rest, up, out = joints(), joints(l_arm_flex=90), joints(l_arm_abd=90)
    assert rest["l_wrist"][1] < rest["l_shoulder"][1] - 0.4  # hanging
    assert up["l_wrist"][2] > up["l_shoulder"][2] + 0.4  # forwards
    assert out["l_wrist"][0] > out["l_shoulder"][0] + 0.4  # to the left, which is +x
    assert joints(l_elbow=90)["l_wrist"][2] > rest["l_wrist"][2] + 0.15
    assert joints(l_hip_flex=90)["l_knee"][2] > rest["l_knee"][2] + 0.3
    assert joints(l_knee=90)["l_ankle"][2] < rest["l_ankle"][2] - 0.3
    assert joints(l_hip_abd=40)["l_ankle"][0] > rest["l_ankle"][0] + 0.3
    assert joints(spine_flex=50)["head"][2] > rest["head"][2] + 0.1
    assert joints(spine_bend=30)["head"][0] > 0.05
    assert joints(spine_twist=40)["l_shoulder"][2] < rest["l_shoulder"][2]
    assert joints(l_ankle=20)["l_foot"][1] > rest["l_foot"][1] + 0.02


def test_wrong_arguments():
    with pytest.raises(UserError, match=r"no built-in motion 'jumping_jack'; did you mean 'jumping_jacks'?"):
        builtin_motion("jumping_jack")
    with pytest.raises(UserError, match=r"no built-in motion 'xyzzy'\. Wanted one of"):
        builtin_motion("xyzzy")
    for wrong in ({"duration_s": 0.0}, {"frame_rate": 0.0}, {"duration_s": 0.001}):
        with pytest.raises(ValueError, match="wanted at least one frame"):
            builtin_motion("hips", **wrong)
    with pytest.raises(ValueError, match="got l_knie"):
        poses_from_angles({"l_knie": np.zeros(1)}, 1)
