"""The sides of normals that the bones inside tell."""

from __future__ import annotations

import numpy as np
import pytest
from point_scenes import POSE, body_mesh, sampled

from snarfcli.bodies import builtin_body, forward_kinematics
from snarfcli.point_clouds import bone_normals


def joints_and_parents() -> tuple[np.ndarray, tuple[int, ...]]:
    skeleton = builtin_body().skeleton()
    joints, _ = forward_kinematics(POSE, skeleton.joints_rest.double(), skeleton.parents)
    return joints[0].numpy(), skeleton.parents


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_normals_of_a_body_point_away_from_its_bones(noise):
    points, true = sampled(body_mesh(), 4000, noise)
    joints, parents = joints_and_parents()
    normals = bone_normals(points, joints, parents)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert ((normals * true).sum(axis=1) < 0).mean() < 0.05
    np.testing.assert_allclose(bone_normals(100 * points, 100 * joints, parents), normals, atol=1e-6)  # any unit


def test_the_trunk_beside_an_arm_is_not_the_arm():
    height = np.linspace(-1, 1, 60)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    across, up = (grid.ravel() for grid in np.meshgrid(angle, height))
    ring = np.stack([np.cos(across), np.zeros_like(up), np.sin(across)], 1)
    trunk, arm = 0.3 * ring, 0.1 * ring + (0.5, 0, 0)  # between them, the bone of the arm is closer to the trunk than its own
    points = np.concatenate([trunk, arm]) + np.tile(up[:, None] * (0, 1, 0), (2, 1))
    joints = np.array([[0, -1, 0], [0, 1, 0], [0.5, -1, 0], [0.5, 1, 0]])
    normals = bone_normals(points, joints, (-1, 0, 0, 2))
    assert ((normals * np.concatenate([ring, ring])).sum(axis=1) > 0.5).mean() > 0.999  # not beside the bone that joins them


def test_a_single_joint_is_the_middle():
    points = np.random.default_rng(0).standard_normal((200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert ((bone_normals(points, np.zeros((1, 3)), (-1,)) * points).sum(axis=1) > 0.8).all()


def test_too_few_points_are_an_error():
    with pytest.raises(ValueError, match="at least 16 points"):
        bone_normals(np.zeros((5, 3)), np.zeros((1, 3)), (-1,))
