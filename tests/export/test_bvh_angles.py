"""Angles that change smoothly and give the rotations back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snarfcli.export.bvh_angles import ORDERS, choose_order, continuous_angles


def back(angles: np.ndarray, order: str) -> np.ndarray:
    return Rotation.from_euler(order, angles.reshape(-1, 3), degrees=True).as_matrix().reshape(*angles.shape, 3)


def spin(axis: str, degrees: np.ndarray) -> np.ndarray:
    """Return rotations [T, 1, 3, 3] about an axis."""
    turns = np.radians(degrees)[:, None] * np.eye(3)["xyz".index(axis)]
    return Rotation.from_rotvec(turns).as_matrix()[:, None]


@pytest.mark.parametrize("order", ORDERS)
def test_the_rotations_come_back_and_nothing_jumps(order):
    random = np.random.default_rng(0)
    time = np.linspace(0, 1, 400)[:, None, None]
    amplitude, phase, pace = (random.uniform(low, high, (1, 5, 3)) for low, high in ((1, 3), (0, 6), (1, 3)))
    rotations = Rotation.from_rotvec((amplitude * np.sin(6 * pace * time + phase)).reshape(-1, 3)).as_matrix()
    rotations = rotations.reshape(400, 5, 3, 3)
    angles = continuous_angles(rotations, order)
    np.testing.assert_allclose(back(angles, order), rotations, atol=1e-12)
    assert np.abs(np.diff(angles, axis=0)).max() <= 180
    usual = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_euler(order, degrees=True).reshape(400, 5, 3)
    assert np.abs(np.diff(angles, axis=0)).sum() < np.abs(np.diff(usual, axis=0)).sum()


def test_a_joint_that_keeps_turning_goes_beyond_180_degrees():
    angles = continuous_angles(spin("y", np.arange(0, 1000, 50)), "ZXY")
    np.testing.assert_allclose(angles[:, 0, 2], np.arange(0, 1000, 50), atol=1e-9)
    np.testing.assert_allclose(angles[:, 0, :2], 0, atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_swing_through_gimbal_lock_is_smooth(order, sign):
    """The middle axis alone turns, from 60 to 120 degrees, with one frame exactly in the lock."""
    swing = sign * np.arange(60.0, 121.0, 5.0)
    start = np.array([20.0, 0, -35.0])
    wanted = np.stack([np.full_like(swing, start[0]), swing, np.full_like(swing, start[2])], 1)[:, None]
    angles = continuous_angles(back(wanted, order), order)
    np.testing.assert_allclose(back(angles, order), back(wanted, order), atol=1e-9)
    np.testing.assert_allclose(angles, wanted, atol=1e-5)


def test_the_order_avoids_the_lock():
    assert choose_order(spin("y", np.linspace(0, 360, 50))[:, 0]) == "ZXY"
    for angle in (80.5, 90.0, -90.0):
        chosen = choose_order(spin("x", np.linspace(0, angle, 50))[:, 0])
        assert chosen[1] != "X"
    assert choose_order(spin("x", np.linspace(0, 75, 50))[:, 0]) == "ZXY"


def test_no_frames_and_no_joints():
    assert continuous_angles(np.zeros((0, 4, 3, 3)), "ZXY").shape == (0, 4, 3)
    assert continuous_angles(np.zeros((3, 0, 3, 3)), "ZXY").shape == (3, 0, 3)
    assert choose_order(np.zeros((0, 3, 3))) == "ZXY"
