"""Angles of poses against the angles that the poses are made from."""

from __future__ import annotations

import numpy as np
import pytest

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, builtin_motion
from snarfcli.motions.anatomy import LIMITS_DEG, poses_from_angles
from snarfcli.motions.layouts import SMPL_X
from snarfcli.registration.joint_limits import angles_from_poses, near_limits, random_poses

ANGLES = [name for name in LIMITS_DEG if not name.startswith("pelvis")]


def random_angles(count: int) -> dict[str, np.ndarray]:
    """Return angles inside the limits, with arms that are raised by less than 180 degrees."""
    draws = np.random.default_rng(0)
    angles = {name: draws.uniform(*LIMITS_DEG[name], count) for name in ANGLES}
    for side in "lr":
        for part in ("flex", "abd"):
            angles[f"{side}_arm_{part}"] = draws.uniform(-40, 110, count)
    return angles


def test_angles_are_those_that_a_pose_is_made_from():
    wanted = random_angles(50)
    found = angles_from_poses(SMPL_JOINT_NAMES, poses_from_angles(wanted, 50))
    assert set(found) == set(ANGLES)
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, atol=1e-6, err_msg=name)


def test_other_layouts_and_spellings():
    poses = poses_from_angles(random_angles(3), 3)
    smpl_x = np.zeros((3, len(SMPL_X), 3))
    smpl_x[:, :22] = poses[:, :22]
    found = angles_from_poses(SMPL_X, smpl_x)
    assert "l_elbow" in found
    assert "l_curl" not in found  # it has fingers in place of SMPL's hands
    capitals = tuple(name.upper() for name in SMPL_JOINT_NAMES)
    np.testing.assert_allclose(angles_from_poses(capitals, poses)["r_knee"], found["r_knee"])
    assert angles_from_poses(("root", "tail"), np.zeros((1, 2, 3))) == {}


@pytest.mark.parametrize(
    ("angles", "joints"),
    [
        ({}, ()),
        ({"l_knee": 144}, ("l_knee",)),
        ({"r_hip_flex": 130, "l_elbow": 149.0}, ("l_elbow", "r_hip")),
        ({"r_pron": -84, "r_wrist_dev": 34}, ("r_wrist",)),
        ({"l_shrug": 29, "head_turn": 75, "spine_twist": -49}, ("spine3", "head", "l_collar")),
    ],
)
def test_joints_near_their_limits_are_named(angles, joints):
    pose = poses_from_angles({name: np.array([value]) for name, value in angles.items()}, 1)[0]
    assert tuple(near_limits(SMPL_JOINT_NAMES, pose[None])) == joints
    assert near_limits(["elsewhere"] * 24, pose[None]) == {}


def test_a_knee_that_is_bent_backwards_is_past_its_limit():
    poses = np.zeros((3, 24, 3))
    poses[1:, SMPL_JOINT_NAMES.index("l_knee"), 0] = np.radians(-20)
    for names, knee in ((SMPL_JOINT_NAMES, "l_knee"), ([name.title() for name in SMPL_JOINT_NAMES], "L_Knee")):
        found = near_limits(names, poses)
        assert list(found) == [knee]
        assert found[knee].tolist() == [1, 2]


def test_built_in_motions_are_inside_the_limits():
    for name in OUT_OF_DISTRIBUTION_SEQUENCES:
        poses = builtin_motion(name, frame_rate=2).poses
        for angle, values in angles_from_poses(SMPL_JOINT_NAMES, poses).items():
            low, high = LIMITS_DEG[angle]
            assert (low - 1e-6 <= values).all(), (name, angle)
            assert (values <= high + 1e-6).all(), (name, angle)


def test_random_poses_are_inside_the_limits():
    poses = random_poses(SMPL_JOINT_NAMES, 200)
    assert poses is not None
    assert poses.shape == (200, 24, 3)
    for angle, values in angles_from_poses(SMPL_JOINT_NAMES, poses).items():
        low, high = LIMITS_DEG[angle]
        assert (low - 1e-6 <= values).all(), angle
        assert (values <= high + 1e-6).all(), angle
        assert np.ptp(values) > 0.8 * (high - low), angle
    np.testing.assert_array_equal(poses, random_poses(SMPL_JOINT_NAMES, 200))
    assert random_poses(["a", "b"], 3) is None
