"""Chamfer distance, normal consistency and F-score on surfaces whose distance is known."""

from __future__ import annotations

import numpy as np
import pytest
from toy_subject import capsule_mesh

from snarfcli.evaluation.surface_metrics import F_SCORE_DISTANCE_M, compare_surfaces, sample_surface


def sphere(radius: float, around: int = 96):
    """Return a fine sphere."""
    return capsule_mesh(0.0, radius, around=around, along=1, cap=48)


def test_points_are_spread_evenly():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 1], [0, 2, 1]], float)
    faces = np.array([[0, 1, 2], [3, 4, 5]])  # areas 0.5 and 3
    points, chosen = sample_surface(vertices, faces, 7000, np.random.default_rng(0))
    assert np.bincount(chosen).tolist() == [1000, 6000]
    np.testing.assert_allclose(points[chosen == 1].mean(0), vertices[3:].mean(0), atol=0.03)
    np.testing.assert_allclose(points[:, 2], chosen, atol=1e-12)  # each lies in its own triangle's plane


def test_equal_surfaces_are_equal():
    made = compare_surfaces(sphere(0.5), sphere(0.5), count=500)
    assert made.chamfer_m < 1e-12
    assert made.f_score == 1.0
    assert made.normal_consistency == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(("gap", "f_score"), [(0.9 * F_SCORE_DISTANCE_M, 1.0), (1.3 * F_SCORE_DISTANCE_M, 0.0)])
def test_concentric_spheres(gap: float, f_score: float):
    made = compare_surfaces(sphere(0.5), sphere(0.5 + gap), count=4000)
    assert made.chamfer_m == pytest.approx(gap, rel=0.05)  # facets of 3 cm stand up to 0.2 mm off the sphere
    assert made.f_score == pytest.approx(f_score, abs=0.01)
    assert made.normal_consistency > 0.999


def test_half_of_a_surface():
    vertices, faces = sphere(0.5)
    half = faces[(vertices[faces][..., 0] > 0).all(1)]
    made = compare_surfaces((vertices, faces), (vertices, half), count=20000)
    # all that is predicted is right, half of what is there is predicted: 2 * 1 * 0.5 / 1.5
    assert made.f_score == pytest.approx(2 / 3, abs=0.02)


def test_inside_out():
    vertices, faces = sphere(0.5)
    assert compare_surfaces((vertices, faces), (vertices, faces[:, ::-1]), count=500).normal_consistency < -0.999


def test_no_area():
    with pytest.raises(ValueError, match="no area"):
        compare_surfaces(sphere(0.5), (np.zeros((3, 3)), np.array([[0, 1, 2]])))
