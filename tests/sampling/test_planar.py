"""Samples of two-dimensional shapes lie on their plane, evenly along the outline, and folds are inside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy_subject import capsule_mesh

from snarfcli.errors import UserError
from snarfcli.sampling import (
    SamplingSettings,
    dequantise,
    frame_generator,
    in_turned_over,
    outline_samples,
    sample_frame,
    winding_numbers,
)

_SETTINGS = SamplingSettings(
    points_per_frame=4000, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0, is_planar=True
)


def prism(corners: np.ndarray, triangles: np.ndarray, height: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Return a flat shape, whose corners [V, 2] all lie on its outline in order, as a closed prism around z = 0."""
    count = len(corners)
    vertices = np.concatenate([np.column_stack([corners, np.full(count, z)]) for z in (-height / 2, height / 2)])
    low = np.arange(count)
    after = np.roll(low, -1)
    walls = [np.stack([low, after, after + count], -1), np.stack([low, after + count, low + count], -1)]
    return vertices, np.concatenate([triangles[:, ::-1], triangles + count, *walls])


RECTANGLE = prism(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 0.5], [0.0, 0.5]]), np.array([[0, 1, 2], [0, 2, 3]]))


def test_outline_is_sampled_evenly() -> None:
    points = outline_samples(*RECTANGLE, 5000, np.random.default_rng(0))
    assert points.shape == (5000, 3)
    assert not points[:, 2].any()
    x, y = points[:, 0], points[:, 1]
    gap = np.minimum(np.minimum(np.abs(x), np.abs(x - 2)), np.minimum(np.abs(y), np.abs(y - 0.5)))
    assert gap.max() < 1e-9
    for side, length in ((y == 0, 2.0), (np.abs(x - 2) < 1e-9, 0.5)):
        assert abs(side.mean() - length / 5) < 2e-3  # equal shares; 5000 independent points would be off by 7e-3
    share = np.histogram(x[y == 0], 10, (0, 2))[0] / (y == 0).sum()
    assert np.abs(share - 0.1).max() < 0.02


def test_a_mesh_without_walls_has_no_outline() -> None:
    vertices = np.array([[0.0, 0, -1], [1, 0, -1], [0, 1, -1], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    with pytest.raises(UserError, match="no upright wall"):
        outline_samples(vertices, np.array([[0, 2, 1], [3, 4, 5]]), 10, np.random.default_rng(0))


def test_frame_lies_exactly_on_the_plane() -> None:
    samples = sample_frame(*RECTANGLE, _SETTINGS, frame_generator(0, "a", 0))
    points = dequantise(samples.points, samples.cube_lower, samples.cube_size)
    assert not points[:, 2].any()
    assert samples.cube_size == pytest.approx(2.2)
    np.testing.assert_allclose(samples.cube_lower, [-0.1, -0.85, -1.1], atol=3e-5)  # of a step of 34 micrometres
    inside = ((points[:, :2] > 0) & (points[:, :2] < [2, 0.5])).all(1)
    np.testing.assert_array_equal(samples.occupied, inside)
    uniform, near = points[:2000, :2], points[2000:, :2]
    assert np.ptp(uniform, axis=0).min() > 2.15
    away = np.abs(near - np.clip(near, 0, [2, 0.5])).max(1)[~inside[2000:]]
    assert 0.003 < away.mean() < 0.02
    assert 0.4 < inside[2000:].mean() < 0.6


def test_spatial_frames_are_as_before() -> None:
    """Planar subjects have not changed the random numbers of spatial ones."""
    vertices, faces = capsule_mesh(0.8, 0.1)
    samples = sample_frame(vertices, faces, replace(_SETTINGS, is_planar=False), frame_generator(0, "a", 0))
    uniform = frame_generator(0, "a", 0).random((2000, 3))
    points = dequantise(samples.points, samples.cube_lower, samples.cube_size)[:2000]
    np.testing.assert_allclose(points, samples.cube_lower + uniform * samples.cube_size, atol=2e-5)


def test_a_fold_is_inside_where_the_winding_number_cancels() -> None:
    # A sheet of three strips; the middle one is turned over, so its right end hangs over the edge at 1.0 and back.
    x = np.array([0.0, 1.0, 0.6])
    corners = np.concatenate([np.column_stack([x, np.zeros(3)]), np.column_stack([x[::-1], np.ones(3)])])
    triangles = np.array([[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]])
    vertices, faces = prism(corners, triangles)
    generator = np.random.default_rng(0)
    points = np.column_stack([generator.uniform([-0.2, 0.01], [1.2, 0.99], (800, 2)), np.zeros(800)])
    winding = np.rint(winding_numbers(vertices, faces, points))
    folded = (points[:, 0] > 0.6) & (points[:, 0] < 1)
    assert (winding[folded] == 0).all()
    assert folded.any()
    np.testing.assert_array_equal(in_turned_over(vertices, faces, points), folded)
    union = (winding > 0.5) | in_turned_over(vertices, faces, points)
    np.testing.assert_array_equal(union, (points[:, 0] > 0) & (points[:, 0] < 1))
    assert not in_turned_over(*RECTANGLE, points).any()
