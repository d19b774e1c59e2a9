"""Floors and other things in scans."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from toy_scans import Z_UP, floor, person, together

from snarfcli.scanned_subjects.surroundings import find_floor, find_parts, robust_box, without_surroundings


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize(("noise", "slope"), [(0.0, 0.0), (0.005, 0.1)])
def test_a_floor_is_found_in_any_unit_and_axis(unit, up, noise, slope):
    body = person()
    lowest = body[0][:, 1].min()
    points, normals = together(body, floor(lowest, noise=noise, slope=slope))
    turn = np.eye(3) if up == "y" else Z_UP.T
    found = find_floor(unit * points @ turn, normals @ turn)
    assert found is not None
    assert found.up == up
    assert found.height == pytest.approx(unit * lowest, abs=0.02 * unit)
    is_above = found.is_above(unit * points @ turn)
    assert is_above[:3000].mean() > 0.93  # without the soles
    assert is_above[3000:].mean() < 0.01


def test_a_person_alone_has_no_floor():
    points, normals = person()
    assert find_floor(points, normals) is None
    lying = points @ Z_UP.T  # on the back
    assert find_floor(lying, normals @ Z_UP.T) is None
    upside_down = together((points, normals), floor(points[:, 1].max() + 0.1))
    assert find_floor(*upside_down) is None  # a ceiling


def test_other_things_stand_apart():
    points, normals = person()
    box = trimesh.creation.box((0.5, 0.9, 0.5))
    places, faces = trimesh.sample.sample_surface(box, 900, seed=0)[:2]
    more = together((points, normals), (places + np.array([1.4, 0, 0]), box.face_normals[faces]))
    parts = find_parts(more[0])
    assert [int(part.is_in.sum()) for part in parts] == [3000, 900]
    assert parts[0].is_in[:3000].all()
    assert parts[1].length == pytest.approx(0.9, abs=0.01)
    alone, _ = without_surroundings(*more, None, has_parts=True)
    np.testing.assert_array_equal(alone, points)


def test_dense_scans_have_the_parts_of_sparse_ones():
    ball = np.random.default_rng(5).standard_normal((30_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate([ball, 0.2 * ball[:3000] + (2, 0, 0)])
    mixed = np.random.default_rng(6).permutation(len(points))
    parts = find_parts(points[mixed])
    assert len(parts) == 2
    np.testing.assert_array_equal(parts[0].is_in, mixed < 30_000)


def test_a_gap_and_stray_points_do_not_split_a_person():
    points, _ = person()
    away = points[np.abs(points[:, 1] - 0.1) > 0.04]
    stray = np.random.default_rng(2).uniform(-3, 3, (8, 3))
    parts = find_parts(np.concatenate([away, stray]))
    assert len(parts) == 1
    assert parts[0].is_in[: len(away)].all()
    assert len(find_parts(np.random.default_rng(4).uniform(0, 1, (300, 3)) * 50)) >= 1  # a cloud of single points
    assert find_parts(points[:500])[0].is_in.sum() > 490  # few points


def test_a_robust_box_leaves_out_stray_points():
    points = np.concatenate([np.random.default_rng(3).uniform(0, 1, (1000, 3)), [[50.0, 50, 50]]])
    lower, upper = robust_box(points)
    assert (upper < 1).all()
    assert (lower > 0).all()
