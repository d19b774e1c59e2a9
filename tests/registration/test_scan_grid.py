"""Look-ups in the grid against exact searches."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from snarfcli.registration.scan_grid import ScanGrid
from snarfcli.registration.scan_points import ScanPoints


def random_scan(size_m: float) -> ScanPoints:
    draws = np.random.default_rng(0)
    normals = draws.normal(size=(500, 3))
    return ScanPoints(draws.uniform(0, size_m, (500, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True))


def test_a_close_point_is_found():
    scan = random_scan(1.0)
    queries = np.random.default_rng(1).uniform(-0.2, 1.2, (20, 50, 3))
    exact, _ = KDTree(scan.points).query(queries)
    found = np.linalg.norm(scan.points[ScanGrid(scan).closest(queries)] - queries, axis=2)
    assert found.shape == (20, 50)
    assert (found - exact).min() > -1e-12
    assert (found - exact).max() < 2 * 0.03 * np.sqrt(3)  # two diagonals of a cell


def test_queries_far_outside_are_answered():
    scan = random_scan(1.0)
    found = ScanGrid(scan).closest(np.array([[100.0, 0, 0], [-100.0, 0, 0]]))
    assert scan.points[found[0], 0] > 0.8
    assert scan.points[found[1], 0] < 0.2


def test_a_large_scan_has_larger_cells():
    scan = random_scan(1000.0)
    exact, _ = KDTree(scan.points).query(scan.points + 0.1)
    found = np.linalg.norm(scan.points[ScanGrid(scan).closest(scan.points + 0.1)] - scan.points - 0.1, axis=1)
    assert (found - exact).max() < 20
