"""Poses from points that are known in every frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from snarfcli.bodies import Skeleton, builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.known_pairs import KnownPairs

BETAS = np.array([1.0, -1.5, 0.5] + [0.0] * 7)


@pytest.fixture(scope="module")
def surface() -> BodySurface:
    return BodySurface.from_body(builtin_body(), 800)


def states(count: int) -> list[BodyState]:
    draws = np.random.default_rng(0)
    poses = draws.normal(0, 0.3, (count, 24, 3))
    poses[:, 0] *= 8  # any orientation
    return [BodyState.from_pose(pose, draws.normal(0, 2, 3), BETAS) for pose in poses]


def test_poses_are_found_from_nowhere(surface):
    true = states(6)
    points = np.stack([surface.posed(state).points for state in true])
    found = KnownPairs(surface, BETAS).find(points)
    assert found.distances.max() < 5e-4  # metres; measured 2e-4, by the pose correctives of the last round but one
    for frame, state in enumerate(true):
        np.testing.assert_allclose(surface.joints(found.state(frame, BETAS)), surface.joints(state), atol=2e-4)


def test_without_pose_correctives_they_are_exact(surface):
    bare = BodySurface(**{**{name: getattr(surface, name) for name in surface.__dataclass_fields__},
                          "correctives": np.zeros((800, 3, 0))})  # fmt: skip
    true = states(3)
    found = KnownPairs(bare, BETAS).find(np.stack([bare.posed(state).points for state in true]))
    assert found.distances.max() < 1e-6
    np.testing.assert_allclose(found.rotations, [state.rotations for state in true], atol=1e-3)


def test_points_of_no_importance_do_not_count(surface):
    (true,) = states(1)
    points = surface.posed(true).points
    wrong = np.arange(800) % 7 == 0
    points[wrong] += 0.2
    found = KnownPairs(surface, BETAS, np.where(wrong, 0.0, 1.0)).find(points[None])
    np.testing.assert_allclose(surface.joints(found.state(0, BETAS)), surface.joints(true), atol=2e-4)
    assert KnownPairs(surface, BETAS).find(points[None]).distances.max() > 0.1


def test_the_mean_distance_is_least(surface):
    (true,) = states(1)
    points = surface.posed(true).points + np.random.default_rng(1).normal(0, 0.01, (800, 3))
    pairs = KnownPairs(surface, BETAS)
    found = pairs.find(points[None])
    assert np.square(found.distances).mean() < np.square(surface.posed(true).points - points).sum(1).mean()
    best = np.square(found.distances).mean()
    for axis in range(3):
        moved = found.state(0, BETAS)
        moved = BodyState(moved.rotations, moved.translation + 0.002 * np.eye(3)[axis], BETAS)
        assert np.square(surface.posed(moved).points - points).sum(1).mean() > best


def test_a_joint_without_points_follows_its_parent():
    joints = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0, 0.0]])
    skeleton = Skeleton(("root", "middle", "tip"), (-1, 0, 1), joints, torch.zeros(3, 3))
    draws = np.random.default_rng(2)
    vertices = draws.uniform(-0.3, 0.3, (40, 3)) + np.array([0, 0.5, 0]) + np.repeat([[0, 0, 0], [0, 2, 0]], 20, 0)
    weights = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 20, 0)
    surface = BodySurface.from_rig(skeleton, vertices, np.array([[0, 1, 2]]), weights, 40)
    pose = np.zeros((3, 3))
    pose[1], pose[0] = [0, 0, 0.8], [0.3, 0.2, 0]
    true = BodyState.from_pose(pose, np.ones(3), np.zeros(0))
    found = KnownPairs(surface, np.zeros(0)).find(surface.posed(true).points[None])
    assert np.isfinite(found.rotations).all()
    assert found.distances.max() < 1e-4
    np.testing.assert_allclose(surface.joints(found.state(0, np.zeros(0))), surface.joints(true), atol=1e-3)
