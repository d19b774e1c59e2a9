"""The 2D stick: weights, angles and labels of SNARF Sec. 4.1 and 4.3, computed in another way."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import Delaunay, cKDTree

from snarfcli.bodies.extent import bone_segments
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.stick2d import STICK_STEPS_DEG, STICK_SUBJECTS, stick_subject, stick_weights
from snarfcli.errors import UserError
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings, check_mesh
from snarfcli.training.fresh import FreshPoints

_REACH, _WIDE, _LONG = 0.7, 0.15, 0.8
_OBJECT, _RADIUS = np.array([0.5, -0.4]), 0.2
_SAMPLING = SamplingSettings(points_per_frame=1600, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
_STEPS = {"train": 1, "test": 1, "ood": 1}


def weight_of_upper(x: float, y: float) -> float:
    """Return the upper bone's weight at one point, with hypotenuses instead of projections."""
    beyond = [max(-_REACH - y, 0.0, y), max(y - _REACH, 0.0, -y)]
    lower, upper = (math.hypot(x, past) for past in beyond)
    return lower / (lower + upper) if lower + upper else 0.5


def moved(points: np.ndarray, lower_rad: float, upper_rad: float) -> np.ndarray:
    """Move points of the stick [N, 2] with complex numbers: two turns, blended."""
    z = points @ [1, 1j]
    foot, upper = -1j * _REACH, np.exp(1j * upper_rad) * z  # the upper bone turns about the middle, which is the origin
    share = np.array([weight_of_upper(x, y) for x, y in points])
    bent = np.stack([z, upper])
    posed = foot + np.exp(1j * lower_rad) * (bent - foot)
    blended = (1 - share) * posed[0] + share * posed[1]
    return np.stack([blended.real, blended.imag], -1)


def angles_deg(sequence) -> np.ndarray:
    """Return the angles of the lower and the upper joint [T, 2], and see that nothing else turns."""
    poses = sequence.motion.poses.copy()
    angles = np.rad2deg(poses[:, 1:3, 2])
    poses[:, 1:3, 2] = 0
    assert not poses.any()
    assert not sequence.motion.translation.any()
    return angles


@pytest.fixture(scope="module")
def sticks():
    return {name: stick_subject(name) for name in STICK_SUBJECTS}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    root: Path = tmp_path_factory.mktemp("stick")
    preprocess_subject(stick_subject("stick_object"), root, _SAMPLING, {"train": 60, "test": 40, "ood": 15})
    return SampleStore.open(root, "stick2d", "stick_object")


def test_weights_are_inverse_distances(sticks) -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform([-_WIDE, -_LONG], [_WIDE, _LONG], (500, 2))
    weights = stick_weights(points)
    np.testing.assert_allclose(weights[:, 1], [weight_of_upper(x, y) for x, y in points], atol=1e-12)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(stick_weights(np.array([[0, -0.3], [0, 0.3], [0, 0]])), [[1, 0], [0, 1], [0.5, 0.5]], atol=1e-8)
    for data in sticks.values():
        own = data.template.weights
        np.testing.assert_allclose(own.sum(1), 1, atol=1e-12)
        assert not own[:, [0, 3]].any()  # root and tip move no vertex


def test_template_is_a_closed_prism_of_the_right_size(sticks) -> None:
    stick, disk = 4 * _WIDE * _LONG, 96 / 2 * math.sin(math.tau / 96) * _RADIUS**2
    for name, area in (("stick", stick), ("stick_object", stick + disk)):
        template = sticks[name].template
        assert check_mesh(template.vertices, template.faces, "parity") == 0
        corners = template.vertices[template.faces]
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        height = np.ptp(template.vertices[:, 2])
        assert volume == pytest.approx(area * height, rel=1e-9)
        assert template.vertices[:, 2].min() == -template.vertices[:, 2].max()
        outline = template.vertices[template.vertices[:, 2] == 0]
        assert len(outline) > 250
    weights = sticks["stick_object"].template.weights
    far = np.linalg.norm(sticks["stick_object"].template.vertices[:, :2] - _OBJECT, axis=1) < _RADIUS + 1e-9
    np.testing.assert_array_equal(weights[:, 4], far.astype(float))
    gap = np.abs(sticks["stick_object"].template.vertices[far, 0]).min() - _WIDE
    assert gap > 0.1  # separate in canonical space


def test_bones_are_where_the_weights_say(sticks) -> None:
    segments = bone_segments(sticks["stick_object"].skeleton).numpy()[..., :2]
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    np.testing.assert_allclose(segments[lengths > 0], [[[0, -_REACH], [0, 0]], [[0, 0], [0, _REACH]]])
    np.testing.assert_allclose(segments[-1], [_OBJECT, _OBJECT])


@pytest.mark.parametrize("name", STICK_SUBJECTS)
def test_angles_are_the_papers(sticks, name: str) -> None:
    train, test, ood = (sticks[name].of_split(split)[0] for split in ("train", "test", "ood"))
    assert np.abs(angles_deg(test)).max() <= 60
    assert len(angles_deg(test)) == 60
    far = np.abs(angles_deg(ood))
    assert far.min() >= 60
    assert far.max() <= 120
    assert len(far) == 60
    assert len({tuple(signs) for signs in np.sign(angles_deg(ood))}) == 4
    angles = angles_deg(train)
    assert np.abs(angles).max() <= 60 + 1e-9
    validated = max(1, round(len(angles) / 10))  # what the store holds back of a training sequence
    trained = angles[:-validated]
    if name in STICK_STEPS_DEG:
        step = STICK_STEPS_DEG[name]
        values = range(-60, 61, step)
        assert {tuple(pair) for pair in trained.round(6)} == {(a, b) for a in values for b in values}
        assert len(trained) == len(values) ** 2
    else:
        assert len(trained) == 120
        assert np.ptp(trained, axis=0).min() > 110


def test_poses_are_the_same_every_time_and_shared_with_the_object(sticks) -> None:
    for name in ("stick", "stick_step30"):
        for one, two in zip(sticks[name].sequences, stick_subject(name).sequences, strict=True):
            np.testing.assert_array_equal(one.motion.poses, two.motion.poses)
    for one, two in zip(sticks["stick"].sequences, sticks["stick_object"].sequences, strict=True):
        np.testing.assert_array_equal(one.motion.poses, two.motion.poses[:, :4])


def test_meshes_are_moved_by_both_bones(sticks) -> None:
    data = sticks["stick_object"]
    canonical = data.template.vertices
    on_stick = data.template.weights[:, 4] == 0
    for sequence, frame in ((data.sequences[1], 3), (data.sequences[2], 5)):
        angles = sequence.motion.poses[frame, 1:3, 2]
        posed = sequence.meshes[frame][0]
        np.testing.assert_allclose(posed[on_stick, :2], moved(canonical[on_stick, :2], *angles), atol=1e-6)  # float32
        np.testing.assert_allclose(posed[:, 2], canonical[:, 2], atol=1e-7)
        np.testing.assert_allclose(posed[~on_stick], canonical[~on_stick], atol=1e-7)


def test_labels_are_the_union_of_what_is_moved(store: SampleStore) -> None:
    """A point is inside if inside points are moved onto it, computed with another triangulation."""
    x, y = np.meshgrid(np.linspace(-_WIDE, _WIDE, 41), np.linspace(-_LONG, _LONG, 161))
    stick = np.stack([x.ravel(), y.ravel()], -1)
    is_border = (np.abs(stick) == [_WIDE, _LONG]).any(1)
    cells = Delaunay(stick).simplices
    overlaps = 0
    for sequence in store.all_sequences:
        for frame in range(sequence.num_frames):
            posed = moved(stick, *sequence.poses[frame, 1:3, 2])
            points, labels = sequence.points(frame)[::5].astype(np.float64), sequence.occupancies(frame)[::5]
            assert not points[:, 2].any()  # exactly on the plane
            in_stick = covered(posed[cells], points[:, :2])
            on_disk = np.linalg.norm(points[:, :2] - _OBJECT, axis=1) < _RADIUS
            overlaps += int((in_stick & on_disk).sum())
            borders = cKDTree(np.concatenate([posed[is_border], _circle()]))
            wrong = points[(in_stick | on_disk) != labels, :2]
            # Chords of a centimetre, of the bent outline and of the disk, and points of it two millimetres apart.
            assert len(wrong) < 5
            assert not (borders.query(wrong)[0] > 6e-3).any()
            near = borders.query(points[sequence.num_uniform // 5 :, :2])[0]
            assert np.quantile(near, 0.98) < 0.035  # Gaussian of 1 cm
    assert overlaps > 15  # the stick reaches the object: changes of topology


def _circle() -> np.ndarray:
    turn = np.linspace(0, math.tau, 1000)
    return _OBJECT + _RADIUS * np.stack([np.cos(turn), np.sin(turn)], -1)


def covered(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points [N, 2] lie in any of the triangles [F, 3, 2], whichever way round, bool [N]."""
    turns = []
    for k in range(3):
        start, end = corners[:, k], corners[:, (k + 1) % 3]
        offset = points[:, None] - start
        turns.append((end - start)[:, 0] * offset[..., 1] - (end - start)[:, 1] * offset[..., 0])
    return ((np.minimum.reduce(turns) >= 0) | (np.maximum.reduce(turns) <= 0)).any(1)


def test_fresh_points_are_of_the_plane_too(store: SampleStore) -> None:
    sequence = store.sequences("train")[0]
    drawn = FreshPoints([sequence], store.manifest["settings"], 1, 1500, 500, seed=0).draw(0)
    points, labels = drawn.points[0], drawn.occupied[0]
    assert points.shape == (2000, 3)
    assert not points[:, 2].any()
    vertices = sequence.vertices(drawn.frames[0][1])
    top = sequence.faces(0)[(vertices[sequence.faces(0)][..., 2] > 0).all(1)]
    chosen = np.r_[0:300, 1500:1800]
    assert (covered(vertices[top][..., :2], points[chosen, :2]) == labels[chosen]).all()
    assert 0.3 < labels[1500:].mean() < 0.7


def test_manifest_says_that_the_samples_are_planar(store: SampleStore) -> None:
    assert store.manifest["settings"]["is_planar"] is True
    assert store.is_planar
    assert store.template is not None
    assert store.template.is_planar
    assert store.template.weights.shape[1] == 5


def test_surface_vertices_of_a_stick_are_on_its_outline(store: SampleStore) -> None:
    assert store.template is not None
    on_surface = store.template.vertices[store.template.surface_vertices()].astype(np.float64)
    assert len(on_surface) == 2 * (24 + 128) + 96
    assert not on_surface[:, 2].any()
    beyond_strip = np.abs(on_surface[:, :2]) - [_WIDE, _LONG]
    on_strip = np.abs(beyond_strip.max(1)) < 1e-6
    on_disk = np.abs(np.hypot(*(on_surface[:, :2] - _OBJECT).T) - _RADIUS) < 1e-6
    assert (on_strip ^ on_disk).all()
    assert on_disk.sum() == 96
    solid = replace(store.template, is_planar=False)
    np.testing.assert_array_equal(solid.surface_vertices(), np.arange(len(solid.vertices)))


def test_other_subjects_keep_their_settings(tmp_path: Path) -> None:
    from toy_subject import toy_subject

    settings = preprocess_subject(toy_subject(), tmp_path, _SAMPLING, {"train": 20, "test": 20, "ood": 20})["settings"]
    assert "is_planar" not in settings


def test_unknown_sticks_and_bodies_are_refused() -> None:
    source = find_dataset("stick2d")
    request = Request(DataConfig(name="stick2d"), Path("data"))
    assert source.subjects(request) == STICK_SUBJECTS
    with pytest.raises(UserError, match="did you mean 'stick_object'"):
        source.load("stick_objct", request)
    with pytest.raises(UserError, match="leave out body="):
        source.load("stick", Request(DataConfig(name="stick2d"), Path("data"), "body.npz"))
