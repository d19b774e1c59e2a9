"""Rotations and forward kinematics, against SciPy's rotations chained joint by joint in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from snarfcli.bodies import axis_angle_to_matrix, forward_kinematics, invert_rigid, matrix_to_axis_angle

ANGLES = [0.0, 1e-9, 1e-5, 1e-3, 0.0999, 0.1001, 1.0, 3.0, np.pi - 1e-6, np.pi]
PARENTS = (-1, 0, 1, 1, 3, 0)


def random_axes(count: int, seed: int = 0) -> torch.Tensor:
    axes = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return axes / axes.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_matrix_agrees_with_scipy(angle):
    vectors = angle * random_axes(40)
    expected = Rotation.from_rotvec(vectors.numpy()).as_matrix()
    np.testing.assert_allclose(axis_angle_to_matrix(vectors).numpy(), expected, atol=1e-14)
    # float32: the angle itself is known to 2e-7
    np.testing.assert_allclose(axis_angle_to_matrix(vectors.float()).numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axis_angle_round_trip(angle, dtype):
    axes = torch.cat([random_axes(40), torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    matrices = axis_angle_to_matrix(angle * axes)
    back = matrix_to_axis_angle(matrices.to(dtype))
    assert back.norm(dim=-1).max() <= np.pi + 1e-6
    # At pi both signs of the axis are right, so matrices are compared.
    tolerance = 1e-13 if dtype == torch.float64 else 2e-6
    torch.testing.assert_close(axis_angle_to_matrix(back.double()), matrices, atol=tolerance, rtol=0)
    if angle < 3.1:
        torch.testing.assert_close(back.double(), angle * axes, atol=10 * tolerance, rtol=0)


def test_rotation_gradients_are_exact_at_zero_and_across_the_series():
    for size in (0.0, 1e-4, 0.0999, 0.1001, 2.0):
        vectors = (size * random_axes(3, seed=1)).requires_grad_()
        assert torch.autograd.gradcheck(axis_angle_to_matrix, vectors, atol=1e-7)
    vectors = (0.5 * random_axes(3, seed=2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: matrix_to_axis_angle(axis_angle_to_matrix(v)), vectors, atol=1e-6)
    zero = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    matrix_to_axis_angle(axis_angle_to_matrix(zero)).sum().backward()
    torch.testing.assert_close(zero.grad, torch.ones(1, 3, dtype=torch.float64))


def test_joints_and_translation_follow_the_pose_s_device_and_dtype():
    pose = torch.zeros(2, len(PARENTS), 3, device="meta")  # a device whose tensors cannot be mixed with those of the CPU
    rest, translation = torch.zeros(len(PARENTS), 3), torch.zeros(2, 3)
    for result in forward_kinematics(pose, rest, PARENTS, translation):
        assert result.device.type == "meta"
    for result in forward_kinematics(torch.zeros(pose.shape), rest.double(), PARENTS, translation.double()):
        assert result.dtype == torch.float32


def reference_kinematics(pose, rest, translation):
    """One frame: global rotations, then positions, by recursion to the root."""

    def place(joint):
        local = Rotation.from_rotvec(pose[joint])
        if PARENTS[joint] < 0:
            return local, rest[joint] + translation
        rotation, position = place(PARENTS[joint])
        return rotation * local, position + rotation.apply(rest[joint] - rest[PARENTS[joint]])

    return [place(joint) for joint in range(len(PARENTS))]


def kinematics_inputs(batch=4, seed=3):
    rng = np.random.default_rng(seed)
    joints = len(PARENTS)
    return rng.normal(size=(batch, joints, 3)), rng.normal(size=(joints, 3)), rng.normal(size=(batch, 3))


def test_forward_kinematics_agrees_with_a_recursion():
    pose, rest, translation = kinematics_inputs()
    joints, transforms = forward_kinematics(*map(torch.from_numpy, (pose, rest)), PARENTS, torch.from_numpy(translation))
    for frame in range(len(pose)):
        for joint, (rotation, position) in enumerate(reference_kinematics(pose[frame], rest, translation[frame])):
            np.testing.assert_allclose(joints[frame, joint], position, atol=1e-12)
            np.testing.assert_allclose(transforms[frame, joint, :3, :3], rotation.as_matrix(), atol=1e-12)
            # a point of the rest pose, moved with its bone
            point = rest[joint] + [0.1, -0.2, 0.3]
            moved = transforms[frame, joint, :3] @ torch.from_numpy(np.append(point, 1))
            np.testing.assert_allclose(moved, position + rotation.apply([0.1, -0.2, 0.3]), atol=1e-12)
    assert torch.equal(transforms[:, :, 3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(4, len(PARENTS), 4))


def test_forward_kinematics_takes_joints_per_frame_and_empty_batches():
    pose, rest, _ = (torch.from_numpy(x) for x in kinematics_inputs())
    shared = forward_kinematics(pose, rest, PARENTS)
    each = forward_kinematics(pose, rest.expand(4, -1, -1), PARENTS)
    torch.testing.assert_close(shared, each)
    joints, transforms = forward_kinematics(pose[:0], rest, PARENTS)
    assert joints.shape == (0, 6, 3)
    assert transforms.shape == (0, 6, 4, 4)


def test_forward_kinematics_gradient():
    pose, rest, translation = (torch.from_numpy(x).requires_grad_() for x in kinematics_inputs(batch=1))
    assert torch.autograd.gradcheck(lambda p, r, t: forward_kinematics(p, r, PARENTS, t), (pose, rest, translation))


def test_rigid_inverse():
    pose, rest, translation = (torch.from_numpy(x) for x in kinematics_inputs())
    transforms = forward_kinematics(pose, rest, PARENTS, translation)[1]
    eye = torch.eye(4, dtype=torch.float64).expand_as(transforms)
    torch.testing.assert_close(invert_rigid(transforms) @ transforms, eye)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: axis_angle_to_matrix(torch.zeros(4)), r"axis_angle: wanted shape \[..., 3\], got \[4\]"),
        (lambda: matrix_to_axis_angle(torch.zeros(3, 4)), r"matrix: wanted shape \[..., 3, 3\], got \[3, 4\]"),
        (lambda: forward_kinematics(torch.zeros(2, 3), torch.zeros(2, 3), (-1, 0)), r"pose: wanted shape \[B, 2, 3\]"),
        (lambda: forward_kinematics(torch.zeros(1, 2, 3), torch.zeros(3, 3), (-1, 0)), "joints_rest: wanted shape"),
        (
            lambda: forward_kinematics(torch.zeros(1, 2, 3), torch.zeros(2, 3), (-1, 0), torch.zeros(3)),
            r"translation: wanted shape \[1, 3\], got \[3\]",
        ),
        (lambda: forward_kinematics(torch.zeros(1, 2, 3), torch.zeros(2, 3), (1, -1)), "parents: wanted every parent"),
    ],
)
def test_wrong_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
