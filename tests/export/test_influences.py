from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from toy_character import ToyCharacter, wave

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.export.influences import dense_weights, few_influences, trial_poses

TOY = ToyCharacter(spread=0.16)
MESH = TOY.skinned_surface(32).mesh
CLIP = clip_transforms(TOY.skeleton, Clip(wave()))
TRIALS = trial_poses(TOY.skeleton, CLIP)


def rms_mm(dense: np.ndarray, poses: np.ndarray) -> float:
    apart = [skin_vertices(MESH.vertices, MESH.weights, pose) - skin_vertices(MESH.vertices, dense, pose) for pose in poses]
    return 1000 * float(np.sqrt(np.square(apart).sum(-1).mean()))


def largest_weights(count: int) -> np.ndarray:
    joints = np.argsort(-MESH.weights, axis=1)[:, :count]
    values = np.take_along_axis(MESH.weights, joints, axis=1)
    return dense_weights(joints, values / values.sum(1, keepdims=True), MESH.weights.shape[1])


@pytest.mark.parametrize(("count", "share"), [(2, 0.8), (4, 0.6)])
def test_fitted_weights_are_better_than_the_largest(count, share):
    joints, weights = few_influences(MESH.weights, count, MESH.vertices, *TRIALS)
    assert joints.shape == weights.shape == (len(MESH.vertices), count)
    assert weights.dtype == np.float32
    np.testing.assert_allclose(weights.sum(1, dtype=np.float64), 1, atol=2e-7 * count)  # as the validator wants it
    assert weights.min() >= 0
    assert (np.diff(weights, axis=1) <= 0).all()
    assert (joints[weights == 0] == 0).all()
    dense = dense_weights(joints, weights, MESH.weights.shape[1])
    assert rms_mm(dense, CLIP) < share * rms_mm(largest_weights(count), CLIP)
    other = clip_transforms(TOY.skeleton, Clip(wave(turn=-1.0)))  # a motion they were not made for
    assert rms_mm(dense, other) < 0.95 * rms_mm(largest_weights(count), other)


def test_weights_that_are_few_stay_as_they_are():
    weights = np.array([[0.7, 0.0, 0.3, 0, 0, 0], [0, 0, 0, 0, 0, 1.0]], dtype=np.float32)
    joints, values = few_influences(weights, 4, MESH.vertices[:2], *TRIALS)
    np.testing.assert_array_equal(joints, [[0, 2, 0, 0], [5, 0, 0, 0]])
    np.testing.assert_allclose(values, [[0.7, 0.3, 0, 0], [1, 0, 0, 0]], atol=1e-7)


def test_more_columns_than_joints_are_zeros():
    joints, values = few_influences(MESH.weights, 8, MESH.vertices, *TRIALS)
    assert joints.shape[1] == 8
    assert (values[:, 6:] == 0).all()
    np.testing.assert_allclose(dense_weights(joints, values, 6), MESH.weights, atol=1e-6)


def test_memory_does_not_grow_with_the_joints():
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(150), 2000).astype(np.float32)
    poses = np.tile(np.eye(4), (16, 150, 1, 1))
    poses[..., :3, 3] = rng.normal(size=(16, 150, 3))
    tracemalloc.start()
    few_influences(weights, 4, rng.normal(size=(2000, 3)).astype(np.float32), poses, np.full(16, 1 / 16))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40e6  # placed by every joint they would take 115 MB


def test_a_clip_that_stands_still_does_not_decide_alone():
    still = trial_poses(TOY.skeleton, CLIP[:1])
    joints, weights = few_influences(MESH.weights, 2, MESH.vertices, *still)
    assert rms_mm(dense_weights(joints, weights, 6), CLIP) < rms_mm(largest_weights(2), CLIP)
