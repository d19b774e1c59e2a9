"""Corrections of poses: against forward kinematics, in sequence, and for bones that stretch."""

from __future__ import annotations

import torch

from snarfcli.bodies import Skeleton, axis_angle_to_matrix, builtin_body
from snarfcli.fitting import Corrections, Corrector

CPU = torch.device("cpu")


def skeleton() -> Skeleton:
    body = builtin_body()
    return body.skeleton(torch.zeros(body.num_betas))


def random_poses(count: int, joints: int, scale: float = 0.5) -> torch.Tensor:
    return scale * torch.randn(count, joints, 3, generator=torch.Generator().manual_seed(0))


def test_corrected_poses_and_bone_transforms_belong_together():
    tree = skeleton()
    pose, turn, shift = random_poses(3, 24), random_poses(3, 24, 0.2), random_poses(3, 1)[:, 0]
    transforms, corrected = Corrector(tree, CPU).correct(tree.posed_from_canonical(pose), pose, Corrections(turn, shift))
    torch.testing.assert_close(transforms, tree.posed_from_canonical(corrected, shift), atol=1e-5, rtol=0)
    assert (axis_angle_to_matrix(corrected) - axis_angle_to_matrix(pose)).abs().max() > 0.1


def test_no_correction_changes_nothing():
    tree, pose = skeleton(), random_poses(2, 24)
    given = tree.posed_from_canonical(pose)
    transforms, corrected = Corrector(tree, CPU).correct(given, pose, Corrections.none(2, 24, pose))
    torch.testing.assert_close(transforms, given, atol=1e-5, rtol=0)
    torch.testing.assert_close(corrected, pose, atol=1e-5, rtol=0)


def test_corrections_in_sequence_equal_one():
    tree, pose = skeleton(), random_poses(2, 24)
    corrector, given = Corrector(tree, CPU), tree.posed_from_canonical(pose)
    first, second = (
        Corrections(random_poses(2, 24, 0.3), torch.ones(2, 3)),
        (random_poses(2, 24, 0.1).flip(0), torch.ones(2, 3)),
    )
    once = corrector.correct(given, pose, first.then(*second))[0]
    twice = corrector.correct(*corrector.correct(given, pose, first), Corrections(*second))[0]
    torch.testing.assert_close(once, twice, atol=1e-4, rtol=0)


def test_bones_that_stretch_keep_their_length_and_descendants_follow():
    tree, pose = skeleton(), random_poses(1, 24)
    given = tree.posed_from_canonical(pose)
    given[:, :, :3, :3] *= 1.2  # not what poses can express
    turn = torch.zeros(1, 24, 3)
    turn[0, tree.names.index("l_shoulder"), 1] = 0.4
    moved, _ = Corrector(tree, CPU).correct(given, pose, Corrections(turn, torch.zeros(1, 3)))
    change = moved @ torch.linalg.inv(given)
    arm = [tree.names.index(name) for name in ("l_shoulder", "l_elbow", "l_wrist", "l_hand")]
    others = [joint for joint in range(24) if joint not in arm]
    torch.testing.assert_close(change[0, others], torch.eye(4).expand(len(others), 4, 4), atol=1e-5, rtol=0)
    for joint in arm:
        torch.testing.assert_close(change[0, joint], change[0, arm[0]], atol=1e-5, rtol=0)
    angle = torch.rad2deg(torch.arccos((change[0, arm[0], :3, :3].trace() - 1) / 2))
    assert abs(float(angle) - torch.rad2deg(torch.tensor(0.4))) < 0.1
    shoulder = (given[0, arm[0]] @ torch.cat([tree.canonical_joints[arm[0]], torch.ones(1)]))[:3]
    torch.testing.assert_close((change[0, arm[0]] @ torch.cat([shoulder, torch.ones(1)]))[:3], shoulder, atol=1e-5, rtol=0)
