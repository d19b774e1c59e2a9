"""Rays with Embree and with libigl, which stands in for it: the same hits, labels and pictures."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from toy_subject import crossing_capsules

from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.render import render
from snarfcli.sampling import ray_parity, rays
from snarfcli.sampling.rays import NO_HIT, count_crossings, ray_mesh, why_no_embree

VERTICES, FACES = crossing_capsules()
TRIANGLE = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))


@pytest.fixture
def hide_embree(monkeypatch):
    """Return the function that makes Embree unavailable."""

    def hide() -> None:
        for name in ("embreex", "embreex.mesh_construction", "embreex.rtcore_scene"):
            monkeypatch.setitem(sys.modules, name, None)
        clear()

    def clear() -> None:
        why_no_embree.cache_clear()
        rays._say.cache_clear()

    clear()
    yield hide
    monkeypatch.undo()
    clear()


@pytest.fixture(params=["embree", "libigl"])
def program(request, hide_embree) -> str:
    if request.param == "libigl":
        hide_embree()
    elif why_no_embree():
        pytest.skip(f"{why_no_embree()}")
    return request.param


@pytest.mark.usefixtures("program")
def test_the_first_hit_on_one_triangle():
    mesh = ray_mesh(*TRIANGLE)
    origins = np.array([[0.25, 0.5, 2], [0.25, 0.5, -3], [2, 2, 2]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1]], np.float32)
    distance = mesh.distances(origins, directions)
    np.testing.assert_allclose(distance[:2], [2, 3], rtol=1e-6)
    assert distance[2] > NO_HIT
    hits = mesh.first_hits(origins, directions)
    assert hits.triangle.tolist() == [0, 0, -1]
    np.testing.assert_allclose(hits.u[:2], 0.25, atol=1e-6)
    np.testing.assert_allclose(hits.v[:2], 0.5, atol=1e-6)
    assert np.isfinite([*hits.u, *hits.v]).all()


@pytest.mark.usefixtures("program")
def test_every_crossing_counts():
    above = np.array([[0.25, 0.5, 1.0], [0.25, 0.5, -1.0]])
    assert count_crossings(*TRIANGLE, above, np.array([0.0, 0, 1])).tolist() == [0, 1]
    centre = VERTICES.mean(axis=0)[None]
    assert count_crossings(VERTICES, FACES, centre, np.array([0.439, 0.618, 0.652]))[0] >= 1


def test_both_give_the_same_hits_and_labels(hide_embree):
    if why_no_embree():
        pytest.skip(f"{why_no_embree()}")
    generator = np.random.default_rng(0)
    origins = generator.uniform(-1, 1, (4000, 3)).astype(np.float32)
    directions = generator.normal(size=(4000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)

    def found() -> tuple[np.ndarray, ...]:
        mesh = ray_mesh(VERTICES, FACES)
        labels = ray_parity(VERTICES, FACES, origins)
        return np.minimum(mesh.distances(origins, directions), NO_HIT), mesh.first_hits(origins, directions).triangle, labels

    first = found()
    hide_embree()
    second = found()
    assert 100 < (first[0] < NO_HIT).sum() < 3900
    assert 100 < first[2].sum() < 3900
    # Rays near an edge hit either of its triangles, or pass; Embree computes in float32.
    assert (np.abs(first[0] - second[0]) < 1e-4).mean() > 0.999
    assert (first[1] == second[1]).mean() > 0.998
    np.testing.assert_array_equal(first[2], second[2])


def test_pictures_are_the_same_and_the_log_says_it_once(hide_embree, caplog):
    mesh = Mesh(VERTICES.astype(np.float32), FACES)
    camera = Camera.framing(mesh.vertices, margin=0.2)
    with caplog.at_level("INFO", "snarfcli"):
        with_embree = None if why_no_embree() else render(mesh, camera, (48, 64))
        assert with_embree is None or not caplog.text
        hide_embree()
        without = [render(mesh, camera, (48, 64)) for _ in range(2)]
    assert caplog.text.count("rays are traced by libigl") == 1
    assert "since embreex is not installed" in caplog.text
    np.testing.assert_array_equal(without[0], without[1])
    assert without[0].std() > 5  # something is drawn
    if with_embree is not None:
        difference = np.abs(with_embree.astype(int) - without[0])
        assert np.quantile(difference, 0.99) <= 1


def test_a_wheel_that_cannot_be_loaded_is_named(hide_embree, monkeypatch):
    def fail(name, *_):
        raise ImportError("libembree4.so: wrong ELF class")

    hide_embree()
    monkeypatch.delitem(sys.modules, "embreex.mesh_construction")
    monkeypatch.delitem(sys.modules, "embreex")
    monkeypatch.setattr("builtins.__import__", fail)
    assert why_no_embree() == "embreex cannot be imported: libembree4.so: wrong ELF class"
