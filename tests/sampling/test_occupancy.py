"""Labels on shapes whose volume is known."""

from __future__ import annotations

import numpy as np
import pytest
from toy_subject import capsule_mesh, crossing_capsules, mesh_volume

from snarfcli.errors import UserError
from snarfcli.sampling import (
    check_mesh,
    count_boundary_edges,
    labels_differ,
    occupancies,
    ray_parity,
    winding_numbers,
)

_COUNT = 40_000


def _uniform(lower: float, upper: float) -> np.ndarray:
    return np.random.default_rng(0).uniform(lower, upper, (_COUNT, 3))


def _tolerance(share: float) -> float:
    return 4 * np.sqrt(share * (1 - share) / _COUNT)  # four standard deviations of a binomial share


@pytest.mark.parametrize("test", ["winding", "parity"])
def test_sphere_holds_its_volume(test: str) -> None:
    vertices, faces = capsule_mesh(0.0, 0.5, around=32, cap=8)
    points = _uniform(-0.6, 0.6)
    inside = occupancies(vertices, faces, points, test)
    share = mesh_volume(vertices, faces) / 1.2**3
    assert abs(inside.mean() - share) < _tolerance(share)
    distance = np.linalg.norm(points, axis=1)
    assert inside[distance < 0.48].all()  # the mesh is inscribed: its faces come within 0.02 of the sphere
    assert not inside[distance > 0.5].any()


def test_overlap_is_inside_by_winding_and_outside_by_parity() -> None:
    radius = 0.2
    vertices, faces = crossing_capsules(1.0, radius)
    points = _uniform(-0.75, 0.75)
    winding = winding_numbers(vertices, faces, points)
    assert np.abs(winding - np.rint(winding)).max() < 0.05
    union, exclusive = occupancies(vertices, faces, points), ray_parity(vertices, faces, points)
    overlap = np.rint(winding) == 2
    common = 16 / 3 * radius**3 / 1.5**3  # Steinmetz solid
    assert abs(overlap.mean() - common) < _tolerance(common) + 0.01 * common  # 1 %: polygons of 64 corners
    assert (union[overlap]).all()
    assert not exclusive[overlap].any()
    np.testing.assert_array_equal(union & ~overlap, exclusive)
    np.testing.assert_array_equal(labels_differ(winding), overlap)
    separate = mesh_volume(vertices, faces) / 1.5**3
    assert abs(union.mean() - (separate - common)) < _tolerance(separate) + 0.01 * common


def test_inverted_region_differs_too() -> None:
    np.testing.assert_array_equal(
        labels_differ(np.array([-1.0, 0.01, 0.99, 2.0, 3.0, -2.0])), [True, False, False, True, False, False]
    )


def test_open_mesh_is_labelled_by_winding_number() -> None:
    vertices, faces = capsule_mesh(0.6, 0.2)
    assert check_mesh(vertices, faces) == 0
    opened = np.delete(faces, [10, 11], axis=0)
    edges = count_boundary_edges(opened)
    assert edges > 0
    assert check_mesh(vertices, opened) == edges
    points = _uniform(-0.4, 1.0)[:2000]
    import igl

    exact = np.asarray(igl.winding_number(vertices, opened.astype(np.int64), points)).reshape(-1)
    np.testing.assert_array_equal(occupancies(vertices, opened, points), exact > 0.5)
    far_from_hole = np.linalg.norm(points - vertices[faces[10]].mean(0), axis=1) > 0.25
    closed = occupancies(vertices, faces, points)
    np.testing.assert_array_equal(occupancies(vertices, opened, points)[far_from_hole], closed[far_from_hole])
    with pytest.raises(UserError, match=rf"is open \({edges} boundary edges\).*inside_test=winding"):
        check_mesh(vertices, opened, "parity")


def test_boundary_edges_of_one_missing_triangle() -> None:
    _, faces = capsule_mesh(0.0, 1.0)
    assert count_boundary_edges(faces) == 0
    assert count_boundary_edges(faces[1:]) == 3
    assert count_boundary_edges(np.concatenate([faces[1:], faces[:1, ::-1]])) == 3  # turned over is not closed either


def test_unusable_meshes_are_rejected() -> None:
    vertices, faces = capsule_mesh(0.0, 1.0)
    broken = vertices.copy()
    broken[3, 1] = np.nan
    for args, message in (
        ((vertices, faces[:0]), "m is empty .*0 faces"),
        ((vertices[:0], faces[:0]), "m is empty"),
        ((broken, faces), "m has 1 vertices that are NaN"),
        ((vertices[:-1], faces), "but a face has vertex index"),
        ((vertices, faces[:, ::-1]), "m is inside out"),
    ):
        with pytest.raises(UserError, match=message):
            check_mesh(*args, name="m")
    with pytest.raises(ValueError, match="test: wanted one of winding, parity, got 'x'"):
        occupancies(vertices, faces, vertices, "x")


def test_no_points_no_labels() -> None:
    vertices, faces = capsule_mesh(0.0, 1.0)
    for test in ("winding", "parity"):
        assert occupancies(vertices, faces, np.zeros((0, 3)), test).shape == (0,)
