"""Poses placed on a scan before any is followed."""

from __future__ import annotations

import numpy as np
from body_scans import body_scan

from snarfcli.bodies import SMPL_JOINT_NAMES, builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.placing import StartClouds
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.rotations import matrix_to_vector, vector_to_matrix
from snarfcli.registration.scan_grid import ScanGrid


def test_the_true_pose_is_placed_where_the_scan_is_and_comes_first():
    surface = BodySurface.from_body(builtin_body(), 300)
    poses = PoseLibrary.builtin(SMPL_JOINT_NAMES, leave_out={"hips"}).poses[::40]
    pose = poses[20].copy()
    yaw = 2 * np.pi * 5 / 16
    pose[0] = matrix_to_vector(vector_to_matrix(np.array([0.0, yaw, 0.0])) @ vector_to_matrix(pose[0]))
    truth = BodyState.from_pose(pose, np.array([1.0, 2.0, 3.0]), np.zeros(10))
    first, *_, last = StartClouds(surface, vector_to_matrix(poses)).placed(ScanGrid(body_scan(truth, 1500)), np.full(10, 0.1))
    np.testing.assert_allclose(first.rotations, truth.rotations, atol=1e-9)
    np.testing.assert_allclose(first.translation, truth.translation, atol=0.02)
    np.testing.assert_array_equal(first.betas, np.full(10, 0.1))
    assert np.abs(last.rotations - truth.rotations).max() > 0.1
