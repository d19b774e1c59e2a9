"""Steps that bring a body onto the points of a scan."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from snarfcli.bodies import builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.matches import agreement
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior, fit_state, scales

PRIOR = PosePrior.weak(24)


@pytest.fixture(scope="module")
def surface() -> BodySurface:
    return BodySurface.from_body(builtin_body(), 600)


@pytest.fixture(scope="module")
def truth() -> BodyState:
    draws = np.random.default_rng(2)
    return BodyState.from_pose(
        draws.normal(0, 0.25, (24, 3)), np.array([0.5, 1.0, -2.0]), np.array([1.5, -1, 0.5, 1] + [0] * 6)
    )


@pytest.fixture(scope="module")
def scan(truth) -> ScanPoints:
    body = builtin_body().to(torch.float64)
    vertices = body.pose(truth.pose[None], truth.betas, truth.translation[None]).vertices[0].numpy()
    mesh = trimesh.Trimesh(vertices, body.faces.numpy(), process=False)
    points, faces = trimesh.sample.sample_surface(mesh, 3000, seed=0)[:2]
    return ScanPoints.sampled(points, mesh.face_normals[faces], 2500)


def errors_m(surface, state, truth) -> np.ndarray:
    return np.linalg.norm(surface.joints(state) - surface.joints(truth), axis=1)


def test_pose_place_and_shape_are_found_from_nearby(surface, truth, scan):
    draws = np.random.default_rng(3)
    start = BodyState.from_pose(truth.pose + draws.normal(0, 0.1, (24, 3)), truth.translation + 0.05, np.zeros(10))
    before = agreement(surface, start, scan)
    found = fit_state(surface, start, scan, scales(0.15, 0.03, 15), PRIOR, shape_is_free=True)
    after = agreement(surface, found, scan)
    assert errors_m(surface, start, truth).mean() > 0.05
    assert errors_m(surface, found, truth).mean() < 0.006  # measured 0.003
    assert after.residual_m < before.residual_m
    assert after.objective < before.objective


def test_the_shape_stays_unless_it_is_free(surface, truth, scan):
    start = BodyState(truth.rotations, truth.translation, np.zeros(10))
    found = fit_state(surface, start, scan, scales(0.05, 0.03, 2), PRIOR)
    np.testing.assert_array_equal(found.betas, np.zeros(10))


def test_rotations_stay_rotations(surface, truth, scan):
    start = BodyState(truth.rotations, truth.translation + 0.1, truth.betas)
    found = fit_state(surface, start, scan, scales(0.1, 0.03, 10), PRIOR, shape_is_free=True)
    np.testing.assert_allclose(
        found.rotations.transpose(0, 2, 1) @ found.rotations, np.broadcast_to(np.eye(3), (24, 3, 3)), atol=1e-12
    )


def test_a_strong_prior_leads_to_its_mean(surface, truth, scan):
    mean = np.full((24, 3), 0.1)
    prior = PosePrior(mean, np.full((24, 3), 100.0))
    found = fit_state(surface, truth, scan, scales(0.1, 0.1, 8), prior)
    np.testing.assert_allclose(found.pose[1:], mean[1:], atol=0.01)


def test_clothes_let_the_body_be_below_the_surface(surface, truth, scan):
    clothed = ScanPoints(scan.points + 0.02 * scan.normals, scan.normals)
    start = BodyState(truth.rotations, truth.translation, truth.betas)
    bare, inside = (
        fit_state(surface, start, clothed, scales(0.08, 0.05, 6), PRIOR, shape_is_free=True, clothes_m=clothes)
        for clothes in (0.0, 0.03)
    )
    grown = [np.abs(state.betas - truth.betas).max() for state in (bare, inside)]
    assert grown[1] < grown[0] / 2


def test_a_perfect_fit_leaves_about_a_millimetre(surface, truth, scan):
    assert agreement(surface, truth, scan).residual_m < 0.002  # measured 0.0012, though the points are 2 cm apart
    noise = np.random.default_rng(0).normal(0, 0.005, scan.points.shape)
    assert agreement(surface, truth, ScanPoints(scan.points + noise, scan.normals)).residual_m < 0.006


def test_parts_that_the_scan_does_not_show_pull_nothing(surface, truth, scan):
    across = np.array([0.9, 0.0, 0.4])
    cut = np.quantile(scan.points @ across, 0.3)  # what is beyond this plane is not in the scan
    is_seen = scan.points @ across > cut
    part = ScanPoints(scan.points[is_seen], scan.normals[is_seen])
    found = fit_state(surface, truth, part, scales(0.15, 0.03, 15), PRIOR)
    seen_joints = surface.joints(truth) @ across > cut + 0.05
    assert errors_m(surface, found, truth)[seen_joints].mean() < 0.004
    assert agreement(surface, truth, part).of_body.max() < 0.06  # what is hidden does not count as far away
    assert agreement(surface, truth, part).misfit < 0.15


def test_everything_disagrees_far_away(surface, truth, scan):
    far = BodyState(truth.rotations, truth.translation + 5.0, truth.betas)
    found = agreement(surface, far, scan)
    assert found.residual_m == pytest.approx(0.1)
    assert found.objective > 1.9
    assert found.of_body.shape == (600,)
    assert found.of_scan.shape == found.partners.shape == (1000,)
