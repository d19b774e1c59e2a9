"""Where a scan ends although the surface goes on."""

from __future__ import annotations

import numpy as np
import pytest

from snarfcli.registration.scan_border import find_border
from snarfcli.registration.scan_points import ScanPoints


def ball(count: int = 3000, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a ball with a radius of 30 cm, and their normals."""
    draws = np.random.default_rng(0)
    normals = draws.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.3 * normals + draws.normal(0, 1, normals.shape) * noise_m, normals


@pytest.mark.parametrize("noise_m", [0.0, 0.005])
def test_a_closed_surface_has_no_border(noise_m):
    points, normals = ball(noise_m=noise_m)
    assert len(find_border(points, normals)) <= 0.002 * len(points)
    assert ScanPoints(points, normals).border is None


@pytest.mark.parametrize("noise_m", [0.0, 0.005])
def test_the_border_is_along_the_cut(noise_m):
    points, normals = ball(noise_m=noise_m)
    is_kept = points[:, 0] < 0.1
    border = find_border(points[is_kept], normals[is_kept])
    angles = np.sort(np.arctan2(border[:, 1], border[:, 2]))
    assert (border[:, 0] > 0.03).mean() > 0.98
    assert np.diff(angles).max() < 0.8  # all around


def test_a_part_of_a_scan_knows_the_border_of_the_whole():
    points, normals = ball()
    is_kept = points[:, 0] < 0.1
    scan = ScanPoints(points[is_kept], normals[is_kept])
    part = scan.first(200).first(100)
    assert len(part) == 100
    assert part.border is scan.border
    assert scan.border is not None


@pytest.mark.parametrize("count", [0, 1, 24, 25])
def test_a_few_points_have_no_border(count):
    points, normals = ball()
    assert len(find_border(points[:count], normals[:count])) <= count
    assert len(find_border(points[:24], normals[:24])) == 0
