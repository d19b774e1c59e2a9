"""One frame from nowhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from body_scans import body_scan

from snarfcli.bodies import builtin_body
from snarfcli.motions import builtin_motion
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.pose_library import PoseLibrary, facing_forwards
from snarfcli.registration.rotations import matrix_to_vector, vector_to_matrix
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior
from snarfcli.registration.starts import PoseFinder

BETAS = np.array([1.2, -1, 0.5, 1] + [0.0] * 6)


@pytest.fixture(scope="module")
def finder() -> PoseFinder:
    body = builtin_body()
    surface = BodySurface.from_body(body, 600)
    library = PoseLibrary.builtin(body.joint_names, leave_out={"deep_squats", "jumping_jacks"})
    return PoseFinder(surface, library, library.prior())


def turned_frame(motion: str, time_s: float, yaw: float) -> BodyState:
    """Return the state at a time of a built-in motion, turned about y."""
    pose = facing_forwards(builtin_motion(motion, 50002, frame_rate=10).poses)[round(10 * time_s)]
    pose[0] = matrix_to_vector(vector_to_matrix(np.array([0.0, yaw, 0.0])) @ vector_to_matrix(pose[0]))
    return BodyState.from_pose(pose, np.array([3.0, -1.0, 2.0]), BETAS)


def errors_m(finder: PoseFinder, state: BodyState, truth: BodyState) -> np.ndarray:
    return np.linalg.norm(finder.surface.joints(state) - finder.surface.joints(truth), axis=1)


@pytest.mark.parametrize(("motion", "time_s", "yaw"), [("jumping_jacks", 1.5, 2.5), ("deep_squats", 1.0, -1.0)])
def test_a_frame_of_an_unknown_motion_is_found_without_its_shape(finder, motion, time_s, yaw):
    truth = turned_frame(motion, time_s, yaw)
    found = finder.find(body_scan(truth))
    assert errors_m(finder, found.state, truth).mean() < 0.010  # measured 0.004
    assert found.agreement.residual_m < 0.005  # the points are about 2 cm apart


def test_a_given_shape_is_kept(finder):
    truth = turned_frame("punching", 1.0, 1.0)
    near = BodyState(truth.rotations, truth.translation, np.zeros(10))
    found = finder.find(body_scan(truth), betas=BETAS, near=[near])
    np.testing.assert_array_equal(found.state.betas, BETAS)
    assert errors_m(finder, found.state, truth).mean() < 0.010


def test_a_state_nearby_helps_where_the_library_does_not(finder):
    unknown = replace(finder.surface, joint_names=tuple(f"joint_{number}" for number in range(24)))
    finder = PoseFinder(unknown, PoseLibrary.of_rig(24), PosePrior.weak(24))
    truth = turned_frame("bridges", 7.0, 0.5)
    near = BodyState.from_pose(truth.pose + 0.05, truth.translation + 0.02, truth.betas)
    scan = body_scan(truth)
    assert errors_m(finder, finder.find(scan).state, truth).mean() > 0.1
    assert errors_m(finder, finder.find(scan, near=[near]).state, truth).mean() < 0.030


def test_noise_and_an_unseen_side_do_not_break_it(finder):
    truth = turned_frame("jumping_jacks", 1.0, 0.7)
    scan = body_scan(truth, 4000)
    seen = scan.normals[:, 2] < np.quantile(scan.normals[:, 2], 0.7)
    noise = np.random.default_rng(0).normal(0, 0.005, scan.points.shape)
    part = ScanPoints((scan.points + noise)[seen], scan.normals[seen])
    assert errors_m(finder, finder.find(part).state, truth).mean() < 0.030


def test_a_wrong_arm_is_found_again(finder):
    truth = turned_frame("jumping_jacks", 1.0, 0.7)
    pose = truth.pose
    pose[16], pose[18] = 0.0, (0.0, -2.0, 0.0)  # left shoulder and elbow
    lost = BodyState.from_pose(pose, truth.translation, truth.betas)
    found = finder.recover(body_scan(truth), lost)
    assert errors_m(finder, lost, truth).max() > 0.2
    assert errors_m(finder, found.state, truth).mean() < 0.010
    np.testing.assert_array_equal(found.state.betas, truth.betas)


def test_clothes_do_not_count_as_misfit(finder):
    truth = turned_frame("punching", 1.0, 1.0)
    bare = body_scan(truth)
    clothed = ScanPoints(bare.points + 0.03 * bare.normals, bare.normals)
    found = finder.find(clothed, betas=BETAS, clothes_m=0.04)
    assert errors_m(finder, found.state, truth).mean() < 0.020
    assert found.agreement.misfit < 0.1  # measured 0.03; 0.5 without the clothes
