"""The labels of a frame against the exact winding number, on a body of 6,890 vertices."""

from __future__ import annotations

import igl
import numpy as np
import pytest

from snarfcli.bodies import builtin_body
from snarfcli.datasets.posed_meshes import BodyMeshes
from snarfcli.motions import builtin_motion
from snarfcli.sampling import (
    SamplingSettings,
    count_boundary_edges,
    dequantise,
    frame_generator,
    sample_frame,
    uniform_surface_samples,
    winding_numbers,
)

_SETTINGS = SamplingSettings(points_per_frame=20_000, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
_ON_THE_SURFACE_M = 1e-5


@pytest.fixture(scope="module")
def posed():
    """The body while it hops, and in a deep squat, where it goes through itself."""
    chosen = {"hops": ("light_hopping_loose", 100), "squats": ("deep_squats", 240)}
    body, meshes = builtin_body(), {}
    for pose, (name, frame) in chosen.items():
        motion = builtin_motion(name, 50002)
        meshes[pose] = BodyMeshes(body, np.zeros(10), motion.poses, motion.translation)[frame]
    return meshes


def exact_winding(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the sum of the signed solid angles of all triangles, over 4 pi, in float64.

    Source: van Oosterom and Strackee, The Solid Angle of a Plane Triangle, 1983, Eq. 8.
    """
    numbers = np.empty(len(points))
    for index, point in enumerate(points.astype(np.float64)):
        a, b, c = (vertices.astype(np.float64)[faces[:, corner]] - point for corner in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("fi,fi->f", a, np.cross(b, c))
        products = [np.einsum("fi,fi->f", *pair) for pair in ((a, b), (b, c), (c, a))]
        numbers[index] = np.arctan2(volume, la * lb * lc + products[0] * lc + products[1] * la + products[2] * lb).sum()
    return numbers / (2 * np.pi)


def check_labels(vertices: np.ndarray, faces: np.ndarray, boundary_edges: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample a frame and compare every label; return the points and their exact winding numbers."""
    samples = sample_frame(vertices, faces, _SETTINGS, frame_generator(0, "labels"), boundary_edges=boundary_edges)
    points = dequantise(samples.points, samples.cube_lower, samples.cube_size).astype(np.float64)
    corners, triangles = vertices.astype(np.float64), faces.astype(np.int64)
    exact = np.asarray(igl.winding_number(corners, triangles, points)).reshape(-1)
    distance = np.sqrt(igl.point_mesh_squared_distance(points, corners, triangles)[0])
    clear = distance > _ON_THE_SURFACE_M
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(samples.occupied[clear], exact[clear] > 0.5)
    return points, exact


@pytest.mark.parametrize("pose", ["hops", "squats"])
def test_labels_of_the_body_are_exact(posed, pose: str) -> None:
    vertices, faces = posed[pose]
    assert len(vertices) == 6890
    assert count_boundary_edges(faces) == 0
    points, exact = check_labels(vertices, faces, 0)
    some = np.random.default_rng(0).choice(len(points), 100, replace=False)
    # libigl adds the same angles in another order; 13,776 terms
    np.testing.assert_allclose(exact[some], exact_winding(vertices, faces, points[some]), atol=1e-9)
    overlapping = np.rint(exact) == 2
    assert overlapping.sum() > 20 if pose == "squats" else not overlapping.any()


def test_labels_of_an_open_mesh_are_exact(posed) -> None:
    vertices, faces = posed["hops"]
    top = vertices[faces].mean(1)[:, 1]
    opened = faces[top < top.max() - 0.1]  # without the upper half of the head
    edges = count_boundary_edges(opened)
    assert edges > 10
    _, exact = check_labels(vertices, opened, edges)
    assert (np.abs(exact - 0.5) < 0.3).sum() > 20  # across the opening it passes through a half gradually


def test_points_almost_on_the_surface_are_labelled_exactly(posed) -> None:
    """The error of the fast sum is largest there, but it still rounds to the correct side."""
    vertices, faces = posed["squats"]
    generator = np.random.default_rng(1)
    points = uniform_surface_samples(vertices, faces, 4000, generator)
    step = generator.normal(size=points.shape)
    points += 3e-5 * step / np.linalg.norm(step, axis=1, keepdims=True)
    corners, triangles = vertices.astype(np.float64), faces.astype(np.int64)
    distance = np.sqrt(igl.point_mesh_squared_distance(points, corners, triangles)[0])
    exact = np.asarray(igl.winding_number(corners, triangles, points)).reshape(-1)
    clear = distance > _ON_THE_SURFACE_M
    assert clear.sum() > 1000
    np.testing.assert_array_equal((winding_numbers(vertices, faces, points) > 0.5)[clear], (exact > 0.5)[clear])
