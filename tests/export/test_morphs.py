from __future__ import annotations

import numpy as np
import pytest

from snarfcli.export.deviation import Deviation
from snarfcli.export.morphs import fit_shapes, spread_frames

RNG = np.random.default_rng(3)
BASE = RNG.normal(size=(50, 3))
MODES = 0.01 * np.linalg.qr(RNG.normal(size=(150, 3)))[0].T.reshape(3, 50, 3)


def shapes(count: int = 20) -> np.ndarray:
    weights = np.random.default_rng(1).normal(size=(count, 3)) * (5, 2, 1)
    return (BASE + np.tensordot(weights, MODES, 1)).astype(np.float32)


def test_as_many_components_as_there_are_give_the_shapes_back():
    given = shapes()
    basis = fit_shapes(given, 8)
    assert len(basis.targets) == 3  # the rest is rounding
    np.testing.assert_allclose(basis.base, given.mean(0), atol=1e-6)
    for shape in given:
        np.testing.assert_allclose(basis.shape(basis.weights(shape)), shape, atol=1e-6)
    flat = basis.targets.reshape(3, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(3), atol=1e-5)


def test_fewer_are_the_best_there_are():
    given = shapes()
    basis = fit_shapes(given, 1)
    left = np.stack([shape - basis.shape(basis.weights(shape)) for shape in given])
    singular = np.linalg.svd((given - given.mean(0)).reshape(20, -1), compute_uv=False)
    assert np.square(left).sum() == pytest.approx(np.square(singular[1:]).sum(), rel=1e-3)


def test_weights_within_0_and_1_give_the_same_shapes():
    given = shapes()
    basis = fit_shapes(given, 2)
    clips = [np.stack([basis.weights(shape) for shape in part]) for part in (given[:7], given[7:])]
    scaled, weights = basis.within_unit_range(clips)
    joined = np.concatenate(weights)
    np.testing.assert_allclose(joined.min(0), 0, atol=1e-6)
    np.testing.assert_allclose(joined.max(0), 1, atol=1e-6)
    assert joined.min() >= 0
    assert joined.max() <= 1
    for old, new in zip(np.concatenate(clips), joined, strict=True):
        np.testing.assert_allclose(scaled.shape(new), basis.shape(old), atol=1e-6)
    np.testing.assert_allclose(scaled.shape(scaled.rest), given.mean(0), atol=1e-6)
    # the base is at the ends that are nearer to the mean
    assert (np.abs(scaled.rest) <= 0.5 + 1e-6).all()


@pytest.mark.parametrize("given", [shapes(1), np.repeat(shapes(1), 5, 0)])
def test_one_shape_has_no_components(given):
    basis = fit_shapes(given, 4)
    assert basis.targets.shape == (0, given.shape[1], 3)
    assert basis.weights(given[0]).shape == (0,)
    np.testing.assert_array_equal(basis.shape(basis.weights(given[0])), given[0])
    assert basis.within_unit_range([np.zeros((5, 0))])[0] is basis


def test_frames_are_spread_over_all_clips():
    assert spread_frames([3], 10) == [(0, 0), (0, 1), (0, 2)]
    picked = spread_frames([300, 100, 1], 40)
    assert len(picked) == 40
    assert picked[0] == (0, 5)
    assert picked[-1] == (1, 95)
    assert set(np.diff([frame + 300 * clip for clip, frame in picked])) <= {10, 11}
    assert spread_frames([9], 1) == [(0, 4)]


def test_many_short_clips_are_seen_in_their_middle():
    assert spread_frames([5] * 4, 4) == [(clip, 2) for clip in range(4)]
    picked = spread_frames([10] * 200, 150)
    assert len(picked) == 150 == len({clip for clip, _ in picked})
    assert len({frame for _, frame in picked}) == 3


def test_deviation_is_over_all_that_came():
    differences = RNG.normal(scale=1e-3, size=(7, 400, 3))
    deviation = Deviation()
    for part in differences:
        deviation.add(part)
    distance = 1000 * np.linalg.norm(differences, axis=2).ravel()
    assert deviation.max_mm == pytest.approx(distance.max())
    assert deviation.rms_mm == pytest.approx(np.sqrt((distance**2).mean()))
    assert deviation.p99_mm == pytest.approx(np.percentile(distance, 99), abs=0.02)  # the next of 2800 samples
    assert Deviation().facts() == {"max_mm": 0.0, "p99_mm": 0.0, "rms_mm": 0.0}
