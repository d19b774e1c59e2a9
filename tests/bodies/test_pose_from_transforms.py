"""From bone transforms back to poses, and what the poses cannot reproduce."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from snarfcli.bodies import builtin_body, forward_kinematics, pose_from_transforms
from snarfcli.bodies.kinematics import nearest_rotation

PARENTS = (-1, 0, 1, 1, 3, 0)


def scene(dtype=torch.float64, frames=5):
    generator = torch.Generator().manual_seed(0)
    poses = torch.randn(frames, 6, 3, generator=generator, dtype=torch.float64)
    rest = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    translation = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    transforms = forward_kinematics(poses, rest, PARENTS, translation)[1]
    return poses.to(dtype), rest.to(dtype), translation.to(dtype), transforms.to(dtype)


# fp64: measured 1e-14; fp32: 3e-6 on poses of up to 3 radians and joints a few metres apart
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_poses_come_back(dtype, tolerance):
    poses, rest, translation, transforms = scene(dtype)
    back, moved, residual = pose_from_transforms(transforms, PARENTS, rest)
    assert back.dtype == dtype
    assert residual.shape == (5,)
    assert residual.max() < tolerance
    for mine, given in zip(back.reshape(-1, 3).numpy(), poses.reshape(-1, 3).numpy(), strict=True):
        difference = Rotation.from_rotvec(mine).inv() * Rotation.from_rotvec(given)
        assert difference.magnitude() < tolerance
    torch.testing.assert_close(moved, translation, atol=tolerance, rtol=0)


def test_poses_of_the_built_in_body_come_back():
    skeleton = builtin_body(torch.float64).skeleton()
    poses = 0.4 * torch.randn(3, 24, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    back, translation, residual = pose_from_transforms(skeleton.posed_from_rest(poses), skeleton.parents, skeleton.joints_rest)
    torch.testing.assert_close(back, poses, atol=1e-12, rtol=0)
    assert translation.abs().max() < 1e-12
    assert residual.max() < 1e-12


def test_a_joint_that_comes_apart_is_in_the_residual():
    _, rest, _, transforms = scene()
    transforms[2, 4, 1, 3] += 0.03
    residual = pose_from_transforms(transforms, PARENTS, rest)[2]
    assert residual[2].item() == pytest.approx(0.03)
    assert residual[[0, 1, 3, 4]].max() < 1e-12


def test_scale_is_left_out_of_the_poses_and_is_in_the_residual():
    poses, rest, _, transforms = scene()
    scaled = transforms.clone()
    scaled[:, 4, :3, :3] *= 1.2  # a leaf, about its joint, so that no joint moves
    scaled[:, 4, :3, 3] += (transforms[:, 4, :3, :3] - scaled[:, 4, :3, :3]) @ rest[4]
    back, _, residual = pose_from_transforms(scaled, PARENTS, rest)
    given, mine = (Rotation.from_rotvec(p[:, 4].numpy()) for p in (poses, back))
    assert (given.inv() * mine).magnitude().max() < 1e-12
    np.testing.assert_allclose(residual, 0.02, atol=1e-12)  # a fifth of the 0.1 m at which it is measured


def test_a_reflection_gives_a_rotation_and_a_residual():
    _, rest, _, transforms = scene()
    transforms[0, 5, :3, 0] *= -1
    back, _, residual = pose_from_transforms(transforms, PARENTS, rest)
    assert back.isfinite().all()
    assert residual[0] > 0.05
    assert residual[1:].max() < 1e-12


def test_nearest_rotation():
    generator = torch.Generator().manual_seed(2)
    rotations = torch.from_numpy(Rotation.random(20, random_state=0).as_matrix())
    torch.testing.assert_close(nearest_rotation(rotations), rotations, atol=0, rtol=0)  # untouched
    stretched = rotations @ torch.diag(torch.tensor([2.0, 0.5, 3.0], dtype=torch.float64))
    torch.testing.assert_close(nearest_rotation(stretched), rotations)
    anything = nearest_rotation(torch.randn(50, 3, 3, generator=generator, dtype=torch.float64))
    torch.testing.assert_close(anything.mT @ anything, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    assert torch.linalg.det(anything).min() > 0.99
    assert torch.linalg.det(nearest_rotation(torch.zeros(3, 3))) == pytest.approx(1)
    assert nearest_rotation(torch.zeros(0, 3, 3)).shape == (0, 3, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transforms": torch.zeros(2, 6, 3, 4)}, r"posed_from_rest: wanted shape \[T, 6, 4, 4\], got \[2, 6, 3, 4\]"),
        ({"transforms": torch.full((2, 6, 4, 4), torch.nan)}, "posed_from_rest: wanted finite numbers"),
        ({"rest": torch.zeros(5, 3)}, r"joints_rest: wanted shape \[6, 3\], got \[5, 3\]"),
        ({"parents": (1, -1, 1, 1, 3, 0)}, "parents: wanted every parent"),
    ],
)
def test_wrong_arguments(change, message):
    _, rest, _, transforms = scene()
    given = {"transforms": transforms, "parents": PARENTS, "rest": rest} | change
    with pytest.raises(ValueError, match=message):
        pose_from_transforms(given["transforms"], given["parents"], given["rest"])
