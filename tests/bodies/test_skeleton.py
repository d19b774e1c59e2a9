"""Skeletons: canonical pose, transforms, serialisation."""

from __future__ import annotations

import pytest
import torch

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, builtin_body, legs_apart_pose


@pytest.fixture(scope="module")
def skeleton():
    return builtin_body().skeleton()


def test_canonical_legs_are_apart(skeleton):
    joints = skeleton.canonical_joints
    left, right = (joints[skeleton.names.index(name)] for name in ("l_ankle", "r_ankle"))
    assert left[0] > 0.5
    assert right[0] < -0.5
    assert skeleton.canonical_pose.count_nonzero() == 2
    arms = [SMPL_JOINT_NAMES.index(name) for name in ("l_wrist", "r_wrist")]
    torch.testing.assert_close(joints[arms], skeleton.joints_rest[arms])


def test_canonical_pose_gives_identity_transforms(skeleton):
    transforms = skeleton.posed_from_canonical(skeleton.canonical_pose[None])
    torch.testing.assert_close(transforms, torch.eye(4).expand(1, 24, 4, 4), atol=1e-6, rtol=0)


def test_transforms_move_canonical_joints_to_posed_joints(skeleton):
    generator = torch.Generator().manual_seed(0)
    pose = torch.randn(3, 24, 3, generator=generator, dtype=torch.float64)
    translation = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    transforms = skeleton.posed_from_canonical(pose, translation)
    assert transforms.dtype == torch.float64
    homogeneous = torch.cat([skeleton.canonical_joints.double(), torch.ones(24, 1)], 1)
    moved = (transforms @ homogeneous[None, :, :, None])[..., :3, 0]
    posed = builtin_body(torch.float64).pose(pose, translation=translation).joints
    torch.testing.assert_close(moved, posed, atol=1e-6, rtol=0)  # the skeleton is stored in float32


def test_sides_and_bones(skeleton):
    assert skeleton.num_joints == 24
    assert len(skeleton.bones) == 23
    assert skeleton.bones[0] == (0, 1)
    for joint, other in enumerate(skeleton.left_right):
        assert skeleton.left_right[other] == joint
        assert skeleton.names[joint][:2] != "l_" or skeleton.names[other] == "r_" + skeleton.names[joint][2:]
    assert skeleton.left_right[0] == 0


def test_survives_a_safe_checkpoint(skeleton, tmp_path):
    torch.save({"skeleton": skeleton.to_dict()}, tmp_path / "a.pt")
    back = Skeleton.from_dict(torch.load(tmp_path / "a.pt", weights_only=True)["skeleton"])
    assert back.names == skeleton.names
    assert back.parents == skeleton.parents
    assert torch.equal(back.joints_rest, skeleton.joints_rest)
    assert torch.equal(back.canonical_pose, skeleton.canonical_pose)
    assert isinstance(back.parents[0], int)


def test_from_arrays_and_to():
    two = Skeleton.from_dict(
        {
            "names": ["root", "tip"],
            "parents": [-1, 0],
            "joints_rest": [[0.0, 0, 0], [0, 1, 0]],
            "canonical_pose": [[0.0] * 3] * 2,
        }
    )
    assert two.to(torch.float64).joints_rest.dtype == torch.float64
    assert legs_apart_pose(two.names).count_nonzero() == 0


def test_wrong_shapes():
    with pytest.raises(ValueError, match=r"joints_rest: wanted shape \[2, 3\], got \[3, 3\]"):
        Skeleton(("a", "b"), (-1, 0), torch.zeros(3, 3), torch.zeros(2, 3))
    with pytest.raises(ValueError, match="names: wanted 2 names"):
        Skeleton(("a",), (-1, 0), torch.zeros(2, 3), torch.zeros(2, 3))
