"""The T-pose of human skeletons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_rigs import a_pose

from snarfcli.bodies import SMPLH_JOINT_NAMES, Skeleton
from snarfcli.export.human_bones import human_bones
from snarfcli.export.t_pose import t_pose_stance
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS, joint_positions
from snarfcli.motions.reader import average_skeleton


def turned(angles: tuple[float, float, float], pose: np.ndarray | None = None) -> Skeleton:
    """Return the average adult at rest in a pose, in another world."""
    pose = np.zeros((24, 3)) if pose is None else pose
    rest = joint_positions(pose[None], np.zeros((1, 3)))[0][0]
    rest = Rotation.from_euler("xyz", angles, degrees=True).apply(rest)
    return replace(average_skeleton(), joints_rest=torch.from_numpy(rest), canonical_pose=torch.zeros(24, 3))


def directions(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """Return the direction of the bone from each joint of the limbs in the T-pose."""
    bones = human_bones(skeleton)
    places = t_pose_stance(skeleton, bones).frames[:, :3, 3]
    found = {}
    for side in ("left", "right"):
        for start, end in (("UpperArm", "LowerArm"), ("LowerArm", "Hand"), ("UpperLeg", "LowerLeg"), ("LowerLeg", "Foot"),
                           ("Foot", "Toes")):  # fmt: skip
            bone = places[bones[side + end]] - places[bones[side + start]]
            found[side + start] = bone / np.linalg.norm(bone)
    return found


@pytest.mark.parametrize("angles", [(0, 0, 0), (90, 0, 0), (0, 90, 0), (-90, 0, 180)])
@pytest.mark.parametrize("pose", [None, a_pose()], ids=["t", "a"])
def test_limbs_have_their_directions_whatever_the_rest_pose(angles, pose):
    skeleton = turned(angles, pose)
    found = directions(skeleton)
    for side, sign in (("left", 1), ("right", -1)):
        for bone in ("UpperArm", "LowerArm"):
            np.testing.assert_allclose(found[side + bone], [sign, 0, 0], atol=1e-9)
        for bone in ("UpperLeg", "LowerLeg"):
            np.testing.assert_allclose(found[side + bone], [0, -1, 0], atol=1e-9)
        assert found[f"{side}Foot"][0] == pytest.approx(0, abs=1e-9)
        assert found[f"{side}Foot"][2] > 0.8
    bones = human_bones(skeleton)
    places = t_pose_stance(skeleton, bones).frames[:, :3, 3]
    np.testing.assert_allclose(places[bones["hips"]][[0, 2]], 0, atol=1e-12)
    assert places[bones["head"]][1] > places[bones["hips"]][1] > places[bones["leftFoot"]][1]


def test_lengths_and_the_frames_of_the_canonical_pose_are_kept():
    skeleton = replace(average_skeleton(), canonical_pose=torch.from_numpy(a_pose()))
    stance = t_pose_stance(skeleton, human_bones(skeleton))
    np.testing.assert_allclose(stance.frames[:, :3, :3], np.tile(np.eye(3), (24, 1, 1)), atol=1e-12)
    canonical = skeleton.canonical_joints.numpy()
    moved = np.einsum("jab,jb->ja", stance.from_canonical[:, :3, :3], canonical) + stance.from_canonical[:, :3, 3]
    np.testing.assert_allclose(moved, stance.frames[:, :3, 3], atol=1e-9)
    for points in (canonical, moved):
        lengths = np.linalg.norm(points[1:] - points[list(PARENTS[1:])], axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(JOINTS_REST[1:] - JOINTS_REST[list(PARENTS[1:])], axis=1), atol=1e-9)


def test_fingers_are_level_and_thumbs_between_x_and_z():
    parents, rest = list(PARENTS[:22]), [*JOINTS_REST[:22]]
    for wrist, sign in ((20, 1), (21, -1)):
        for finger in range(5):
            for number in range(3):
                parents.append(wrist if number == 0 else len(parents) - 1)
                rest.append(JOINTS_REST[wrist] + [sign * (0.08 + 0.03 * number), -0.01 * number**2, 0.02 * (finger - 1)])
    skeleton = Skeleton(SMPLH_JOINT_NAMES, tuple(parents), torch.from_numpy(np.array(rest)), torch.zeros(52, 3))
    bones = human_bones(skeleton)
    assert len(bones) == 22 + 30
    places = t_pose_stance(skeleton, bones).frames[:, :3, 3]
    for start, end, aim in (
        ("leftIndexProximal", "leftIndexIntermediate", [1, 0, 0]),
        ("rightLittleIntermediate", "rightLittleDistal", [-1, 0, 0]),
        ("leftThumbMetacarpal", "leftThumbProximal", [1, 0, 1]),
        ("rightThumbProximal", "rightThumbDistal", [-1, 0, 1]),
    ):
        bone = places[bones[end]] - places[bones[start]]
        np.testing.assert_allclose(bone / np.linalg.norm(bone), np.array(aim) / np.linalg.norm(aim), atol=1e-9)
