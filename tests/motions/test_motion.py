"""Cutting and resampling motions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snarfcli.motions import Motion


@pytest.fixture
def motion():
    """Two joints turning steadily about fixed axes for one second, moving steadily upwards."""
    t = np.arange(31) / 30.0
    poses = np.stack([np.outer(2 * t, [0, 1.0, 0]), np.outer(t, [0.6, 0, 0.8])], 1)
    return Motion("turn", poses, np.outer(t, [0.0, 1.0, 0.0]), 30.0)


def test_slice(motion):
    part = motion.slice(5, 20, 3)
    assert part.num_frames == 5
    assert part.frame_rate == 10.0
    assert part.name == "turn"
    np.testing.assert_array_equal(part.poses, motion.poses[5:20:3])
    assert motion.slice(-3).num_frames == 3


def test_resampled_keeps_the_pace(motion):
    for rate in (60.0, 24.0, 7.0):
        other = motion.resampled(rate)
        t = np.arange(other.num_frames) / rate
        assert other.num_frames == int(rate) + 1
        assert other.frame_rate == rate
        np.testing.assert_allclose(other.poses[:, 0], np.outer(2 * t, [0, 1.0, 0]), atol=1e-12)
        np.testing.assert_allclose(other.translation[:, 1], t, atol=1e-12)


def test_resampled_takes_the_short_way_round():
    poses = np.array([[[0, 0, np.pi - 0.1]], [[0, 0, -np.pi + 0.1]]])
    middle = Motion("m", poses, np.zeros((2, 3)), 1.0).resampled(2.0).poses[1, 0]
    assert Rotation.from_rotvec(middle).magnitude() == pytest.approx(np.pi)


def test_single_frame():
    one = Motion("one", np.zeros((1, 2, 3)), np.zeros((1, 3)), 30.0)
    assert one.resampled(60.0).num_frames == 1


def test_wrong_arguments(motion):
    with pytest.raises(ValueError, match="no frame of turn is in 40:50; it has 31 frames"):
        motion.slice(40, 50)
    with pytest.raises(ValueError, match="step: wanted a positive number, got 0"):
        motion.slice(step=0)
    with pytest.raises(ValueError, match="frame_rate: wanted a positive number"):
        motion.resampled(0.0)
    with pytest.raises(ValueError, match="poses: wanted shape"):
        Motion("x", np.zeros((0, 2, 3)), np.zeros((0, 3)), 30.0)
    with pytest.raises(ValueError, match="translation: wanted shape"):
        Motion("x", np.zeros((2, 2, 3)), np.zeros((1, 3)), 30.0)
    with pytest.raises(ValueError, match="frame_rate: wanted a positive number"):
        Motion("x", np.zeros((2, 2, 3)), np.zeros((2, 3)), float("nan"))
