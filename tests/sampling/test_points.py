"""Positions of the points of a frame, and labels of exactly the stored points."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from toy_subject import capsule_mesh, crossing_capsules, mesh_volume

from snarfcli.errors import UserError
from snarfcli.sampling import (
    POISSON,
    BrokenFrame,
    SamplingSettings,
    check_frames,
    dequantise,
    frame_generator,
    quantise,
    ray_parity,
    sample_frame,
    sample_frames,
    sampling_cube,
    surface_samples,
    winding_numbers,
)

_SETTINGS = SamplingSettings(points_per_frame=8000, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)


def test_cube_is_the_longest_side_and_a_tenth() -> None:
    vertices, _ = capsule_mesh(0.8, 0.1)
    lower, size = sampling_cube(vertices + 5)
    assert size == pytest.approx(1.1)
    np.testing.assert_allclose(lower + size / 2, [5.4, 5, 5], atol=1e-6)


def test_quantisation_keeps_points_within_half_a_step() -> None:
    generator = np.random.default_rng(0)
    lower, size = np.array([-3.0, 1, 0.5], np.float32), np.float32(1.9)
    points = lower + generator.random((5000, 3)) * size
    cells = quantise(points, lower, size)
    back = dequantise(cells, lower, size)
    assert cells.dtype == np.uint16
    assert back.dtype == np.float32
    assert np.abs(back - points).max() <= size / 65536 * 0.5 + 3e-7  # fp32 rounding at 3 m
    np.testing.assert_array_equal(quantise(back.astype(np.float64), lower, size), cells)
    outside = np.array([[-9.0, 9, 9], [-3, 1, 0.5]])
    np.testing.assert_array_equal(quantise(outside, lower, size), [[0, 65535, 65535], [0, 0, 0]])


@pytest.mark.parametrize("poisson", POISSON)
@pytest.mark.parametrize("count", [5, 3000])
def test_surface_samples_lie_evenly_on_the_surface(count: int, poisson: str) -> None:
    vertices, faces = capsule_mesh(0.0, 0.5, around=48, cap=12)
    points = surface_samples(vertices, faces, count, np.random.default_rng(1), poisson)
    assert points.shape == (count, 3)
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() <= 0.5 + 1e-6
    assert radius.min() > 0.5 * np.cos(np.pi / 24) * np.cos(np.pi / 48) - 1e-6
    if count > 1000:
        octants = np.bincount((points > 0) @ [1, 2, 4], minlength=8)
        assert np.abs(octants / count - 1 / 8).max() < 0.01  # Poisson disks: far below the 0.018 of chance (3 sigma)
        nearest = cKDTree(points).query(points, k=2)[0][:, 1]
        assert np.median(nearest) > 0.6 * np.sqrt(np.pi / count)  # chance gives 0.47 of the square root of the area each


def test_missing_samples_are_drawn_from_the_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("snarfcli.sampling.surface._POISSON_REQUEST", 0.2)
    vertices, faces = capsule_mesh(0.5, 0.1)
    points = surface_samples(vertices, faces, 2000, np.random.default_rng(1))
    assert points.shape == (2000, 3)
    distance = np.linalg.norm(points - np.clip(points[:, :1], 0, 0.5) * [1, 0, 0], axis=1)
    assert distance.max() <= 0.1 + 1e-6
    assert distance.min() > 0.096
    assert abs((points[:, 0] < 0.25).mean() - 0.5) < 0.03


def test_a_surface_without_area_is_rejected() -> None:
    with pytest.raises(UserError, match="no area"):
        surface_samples(np.zeros((3, 3)), np.array([[0, 1, 2]]), 10, np.random.default_rng(0))
    for height in (1e-18, 1e-160):  # MeshLab would go on for ever
        thin = np.array([[0, 0, 0], [1, 0, 0], [0.5, height, 0]])
        with pytest.raises(UserError, match=r"next to no area .*, 1 m long"):
            surface_samples(thin, np.array([[0, 1, 2]]), 10_000, np.random.default_rng(0))


def test_vertices_that_no_face_uses_do_not_count() -> None:
    vertices, faces = capsule_mesh(0.5, 0.1)
    settings = replace(_SETTINGS, points_per_frame=80)
    alone = sample_frame(vertices, faces, settings, frame_generator(0))
    beside = sample_frame(np.concatenate([vertices, [[40, 0, 0]]]), faces, settings, frame_generator(0))
    for name in ("cube_lower", "cube_size", "box_lower", "box_upper"):
        np.testing.assert_array_equal(getattr(beside, name), getattr(alone, name))
    np.testing.assert_array_equal(beside.vertices[:-1], alone.vertices)
    np.testing.assert_array_equal(beside.points[:40], alone.points[:40])


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ([1, np.nan, 1], "walk, frame 7: the mesh has .* vertices that are NaN"),
        ([1e200] * 3, r"walk, frame 7: the mesh has a vertex .*e\+199 m from the origin"),
        ([1e8] * 3, r"walk, frame 7: the mesh has a vertex .* m from the origin"),
        ([1, 0, 0], "walk, frame 7: mesh has no area"),
    ],
)
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("file", ["", "0007.ply"])
def test_a_frame_that_cannot_be_used_is_named(scale: list[float], message: str, first: bool, file: str) -> None:
    class Meshes(list):
        def source(self, index: int) -> str:
            return file

    vertices, faces = capsule_mesh(0.5, 0.1)
    meshes = Meshes(([] if first else [(vertices, faces)]) + [(vertices * scale, faces), (vertices, faces)])
    settings = replace(_SETTINGS, points_per_frame=80)
    *good, broken = sample_frames(meshes, settings, ("fox", "walk"), [7, 8] if first else [5, 7, 8])
    assert len(good) == (0 if first else 1)
    message = message.replace("frame 7", f"frame 7 \\({file}\\)") if file else message
    assert isinstance(broken, BrokenFrame)
    assert re.match(message, broken.message)
    checks = list(check_frames(meshes, "winding", "walk", [7, 8] if first else [5, 7, 8]))
    if "no area" in message:
        assert checks == [None] * len(meshes)  # that shows when it is sampled
    else:
        assert len(checks) == len(good) + 1
        assert checks[-1] == broken


def test_frame_has_both_kinds_of_points() -> None:
    vertices, faces = capsule_mesh(0.0, 0.5, around=64, cap=16)
    samples = sample_frame(vertices, faces, _SETTINGS, frame_generator(0, "a", 3))
    points = dequantise(samples.points, samples.cube_lower, samples.cube_size)
    uniform, near = points[:4000], points[4000:]
    assert points.shape == (8000, 3)
    assert samples.occupied.shape == (8000,)
    for axis in range(3):
        counts = np.histogram(uniform[:, axis], bins=8, range=(-0.55, 0.55))[0]
        assert ((counts - 500) ** 2 / 500).sum() < 24.3  # chi square, 7 degrees of freedom, one in a thousand
    share = mesh_volume(vertices, faces) / 1.1**3
    assert abs(samples.occupied[:4000].mean() - share) < 4 * np.sqrt(share / 4000)
    distance = np.linalg.norm(near, axis=1) - 0.5
    # one axis of isotropic noise; polygons and curvature add some 0.1 mm; 4000 values: 1.1 % and 0.16 mm are one sigma
    assert abs(distance.std() - 0.01) < 0.0005
    assert abs(distance.mean()) < 0.0015
    assert 0.35 < samples.occupied[4000:].mean() < 0.55


@pytest.mark.parametrize("test", ["winding", "parity"])
def test_labels_are_those_of_the_stored_points(test: str) -> None:
    vertices, faces = crossing_capsules(around=24)
    samples = sample_frame(vertices, faces, replace(_SETTINGS, inside_test=test), frame_generator(0, "a", 3))
    points = dequantise(samples.points, samples.cube_lower, samples.cube_size)
    winding = winding_numbers(vertices, faces, points)
    wanted = winding > 0.5 if test == "winding" else ray_parity(vertices, faces, points)
    np.testing.assert_array_equal(samples.occupied, wanted)
    assert samples.differing == (np.rint(winding) == 2).sum() > 0


def test_noise_beyond_the_cube_stays_on_its_border() -> None:
    vertices, faces = capsule_mesh(0.0, 0.02)
    samples = sample_frame(vertices, faces, replace(_SETTINGS, surface_noise_m=0.05), frame_generator(0))
    points = dequantise(samples.points, samples.cube_lower, samples.cube_size)
    assert (points >= samples.cube_lower).all()
    assert (points <= samples.cube_lower + samples.cube_size).all()
    np.testing.assert_array_equal(samples.occupied, winding_numbers(vertices, faces, points) > 0.5)


def test_generator_depends_on_every_name() -> None:
    draws = [frame_generator(*names).random() for names in ((0, "s", "a", 1), (1, "s", "a", 1), (0, "t", "a", 1))]
    draws += [frame_generator(*names).random() for names in ((0, "s", "b", 1), (0, "s", "a", 2))]
    assert len(set(draws)) == 5
    assert frame_generator(0, "s", "a", 1).random() == draws[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points_per_frame": 12}, "multiple of 8, got 12"),
        ({"points_per_frame": 0}, "multiple of 8, got 0"),
        ({"surface_noise_m": -1.0}, "surface_noise_m"),
        ({"padding": float("nan")}, "padding"),
        ({"inside_test": "windin"}, "did you mean 'winding'"),
    ],
)
def test_settings_that_cannot_be_used_are_rejected(change: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        replace(_SETTINGS, **change)
