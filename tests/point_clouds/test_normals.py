"""Normals of points: directions and sides."""

from __future__ import annotations

import numpy as np
import pytest
from point_scenes import body_mesh, sampled

from snarfcli.point_clouds import check_normals, estimate_normals


def ball(count: int = 600) -> np.ndarray:
    points = np.random.default_rng(0).standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_normals_of_a_ball_point_outward():
    points = ball()
    assert ((estimate_normals(points) * points).sum(axis=1) > 0.9).all()
    np.testing.assert_allclose(estimate_normals(5 + 1000 * points), estimate_normals(points), atol=1e-6)


def test_normals_of_an_open_scan_point_outward():
    half = ball(1000)
    half = half[half[:, 2] > 0.1]
    assert ((estimate_normals(half) * half).sum(axis=1) > 0.8).all()


def test_several_objects_each_get_their_side():
    points = np.concatenate([ball(), 0.5 * ball() + (4, 0, 0), 0.2 * ball() + (0, 3, 0)])
    outward = np.concatenate([ball()] * 3)
    assert ((estimate_normals(points) * outward).sum(axis=1) > 0.8).all()


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_normals_of_a_body_point_outward(noise):
    points, true = sampled(body_mesh(), 4000, noise)
    estimated = estimate_normals(points)
    along = (estimated * true).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(estimated, axis=1), 1.0)
    assert (along > 0).mean() > 0.93  # hands and feet are thinner than the distance between points
    assert np.median(along) > 0.95


def test_given_normals_are_kept_or_turned():
    points, true = sampled(body_mesh(), 2000)
    kept = check_normals(points, 3 * true)
    assert kept.change == ""
    np.testing.assert_allclose(kept.normals, true)
    turned = check_normals(points, -true)
    assert "pointed inward" in turned.change
    np.testing.assert_allclose(turned.normals, true)
    signs = np.random.default_rng(2).choice([-1.0, 1.0], (len(true), 1))
    mixed = check_normals(points, signs * true)
    assert "both sides" in mixed.change
    assert ((mixed.normals * true).sum(axis=1) > 0.5).mean() > 0.9


@pytest.mark.filterwarnings("error")
def test_points_of_no_area_do_no_harm():
    points = np.concatenate([ball(), np.zeros((20, 3))])  # depth cameras put points without depth there
    outward = np.concatenate([ball(), np.zeros((20, 3))])
    for normals in (estimate_normals(points), check_normals(points, -outward).normals):
        assert np.isfinite(normals).all()
        assert ((normals * outward)[:600].sum(axis=1) > 0.9).all()
    assert np.isfinite(estimate_normals(np.zeros((20, 3)))).all()


def test_given_directions_that_are_no_normals_are_replaced():
    points = ball()
    made = check_normals(points, np.random.default_rng(3).standard_normal(points.shape))
    assert "not normal" in made.change
    assert ((made.normals * points).sum(axis=1) > 0.9).all()
    some = points.copy()
    some[:40] = 0.0
    some[40:50] = np.nan
    partly = check_normals(points, some)
    assert "missing at 50 points" in partly.change
    assert ((partly.normals * points).sum(axis=1) > 0.9).all()


def test_too_few_points_are_an_error():
    with pytest.raises(ValueError, match="at least 16"):
        estimate_normals(ball(15))
