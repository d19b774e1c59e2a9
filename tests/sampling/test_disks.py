"""Poisson disks of snarf's own: how they are spaced, that the generator decides them, and which program is chosen."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
from scipy.spatial import KDTree
from toy_subject import capsule_mesh

from snarfcli.errors import UserError
from snarfcli.sampling import SamplingSettings, choose_poisson, recorded_settings, surface_samples
from snarfcli.sampling.disks import poisson_disks
from snarfcli.sampling.surface import _triangles

VERTICES, FACES = capsule_mesh(0.5, 0.1)


@pytest.fixture
def without_meshlab(monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "pymeshlab", None)  # an import would fail


def disks(count: int, seed: int = 0) -> np.ndarray:
    return poisson_disks(*_triangles(VERTICES, FACES), count, np.random.default_rng(seed))


@pytest.mark.parametrize("count", [1, 2, 1000, 3000])
def test_no_two_are_closer_than_the_radius(count):
    points = disks(count)
    radius = np.sqrt(0.49 * _triangles(VERTICES, FACES)[1].sum() / count)
    assert len(points) > 0
    assert not KDTree(points).query_pairs(radius)
    if count >= 1000:
        assert 1 <= len(points) / count < 1.06
        candidates = poisson_disks(*_triangles(VERTICES, FACES), 10 * count, np.random.default_rng(1))
        assert KDTree(points).query(candidates)[0].max() < 2 * radius  # no gap has room for two more


def test_first_come_first_served():
    """The same as adding the candidates one by one."""
    from snarfcli.sampling.disks import _first_come

    points = np.random.default_rng(3).random((400, 3))
    kept: list[int] = []
    for index, point in enumerate(points):
        if not kept or np.linalg.norm(points[kept] - point, axis=1).min() > 0.2:
            kept.append(index)
    assert np.flatnonzero(_first_come(points, 0.2)).tolist() == kept


def test_the_generator_decides_the_points():
    draws = [surface_samples(VERTICES, FACES, 500, np.random.default_rng(seed), "own") for seed in (0, 0, 1)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.isin(draws[0], draws[2]).all()


def test_both_sides_of_a_thin_sheet_are_sampled():
    corners = np.array([[x, y, z] for z in (0.0, 1e-4) for x in (0.0, 1.0) for y in (0.0, 1.0)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7]])
    points = surface_samples(corners, faces, 2000, np.random.default_rng(0), "own")
    assert points.shape == (2000, 3)
    assert abs((points[:, 2] > 5e-5).mean() - 0.5) < 0.05


@pytest.mark.usefixtures("without_meshlab")
def test_without_meshlab_its_own_code_is_chosen_and_the_log_says_so(caplog):
    with caplog.at_level("INFO", "snarfcli"):
        assert choose_poisson("auto") == "own"
        assert "since pymeshlab is not installed (poisson=own)" in caplog.text
        caplog.clear()
        assert choose_poisson("own") == "own"
        assert not caplog.text
    with pytest.raises(UserError, match="pymeshlab is not installed; give poisson=own, or install it with"):
        choose_poisson("pymeshlab")
    assert len(surface_samples(VERTICES, FACES, 50, np.random.default_rng(0), choose_poisson("auto"))) == 50


def test_meshlab_is_chosen_where_it_is_installed(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert choose_poisson("auto") == choose_poisson("pymeshlab") == "pymeshlab"
    with pytest.raises(UserError, match=r"poisson: wanted one of auto, pymeshlab, own, got 'ovn'; did you mean 'own'\?"):
        choose_poisson("ovn")


def test_samples_record_what_differs_from_older_ones():
    usual = SamplingSettings(points_per_frame=8, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    older = {"points_per_frame": 8, "surface_noise_m": 0.01, "padding": 0.1, "inside_test": "winding", "seed": 0}
    assert recorded_settings(usual) == older
    assert recorded_settings(SamplingSettings(**older, poisson="own")) == {**older, "poisson": "own"}
    with pytest.raises(UserError, match="poisson: wanted pymeshlab or own, got auto"):
        SamplingSettings(**older, poisson="auto")
