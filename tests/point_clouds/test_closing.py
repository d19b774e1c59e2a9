"""Surfaces around points: closed, near the points, also without a part of them."""

from __future__ import annotations

import numpy as np
import pytest
from point_scenes import body_mesh, sampled, volume_iou

from snarfcli.point_clouds import close_surface
from snarfcli.sampling import check_mesh


def test_the_surface_of_a_body_is_closed_and_near_the_true_one():
    mesh = body_mesh()
    points, normals = sampled(mesh, 4000)
    vertices, faces = close_surface(points, normals)
    assert check_mesh(vertices, faces) == 0  # closed and outward
    assert volume_iou((vertices, faces), mesh) > 0.96  # measured 0.974


def test_noise_of_five_millimetres_costs_little():
    mesh = body_mesh()
    points, normals = sampled(mesh, 4000, noise=0.005)
    assert volume_iou(close_surface(points, normals), mesh) > 0.93  # measured 0.955


def test_missing_feet_are_closed():
    mesh = body_mesh()
    points, normals = sampled(mesh, 4000)
    above = points[:, 1] > points[:, 1].min() + 0.12
    vertices, faces = close_surface(points[above], normals[above])
    assert check_mesh(vertices, faces) == 0
    assert volume_iou((vertices, faces), mesh, lowest=points[above, 1].min()) > 0.95


def test_the_unit_makes_no_difference():
    points, normals = sampled(body_mesh(), 1000)
    vertices, faces = close_surface(points, normals)
    for unit in (1e3, 1e25, 1e-25):
        scaled, same = close_surface(unit * points, normals)
        np.testing.assert_array_equal(same, faces)
        np.testing.assert_allclose(scaled, unit * vertices, atol=1e-4 * unit)


def test_inward_normals_are_an_error():
    points, normals = sampled(body_mesh(), 1000)
    with pytest.raises(ValueError, match="wanted outward"):
        close_surface(points, -normals)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((3, 3)), "at least 16 points"),
        (np.full((20, 3), np.nan), "NaN"),
        (np.zeros((20, 3)), "most of them twice"),
    ],
)
def test_points_that_are_no_surface_are_an_error(points, message):
    with pytest.raises(ValueError, match=message):
        close_surface(points, np.ones_like(points))
