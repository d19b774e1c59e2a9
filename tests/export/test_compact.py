"""Characters stored with 8 and 16 bits, against the same with float32."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from glb_reader import GlbReader, needs_readers, run_reader
from toy_character import FRAME_RATE, ToyCharacter, stretched, wave

from snarfcli.export.character import Character, CharacterOptions
from snarfcli.export.character_build import build_character
from snarfcli.export.character_glb import character_glb
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip
from snarfcli.export.compact import shares, signed_bytes, signed_shares

OPTIONS = CharacterOptions(triangles=600, resolution=40)


@pytest.fixture(scope="module")
def toy() -> ToyCharacter:
    return ToyCharacter()


@pytest.fixture(scope="module")
def character(toy) -> Character:
    clips = [Clip(wave()), stretched(wave(5, "stretched"), toy, scale=1.2)]
    return build_character(toy, character_surface(toy, OPTIONS), clips, OPTIONS)


@pytest.fixture(scope="module")
def files(toy, character, tmp_path_factory) -> dict[bool, Path]:
    folder = tmp_path_factory.mktemp("compact")
    for compact in (False, True):
        options = {"weight_colors": True, "compact": compact}
        builder, _ = character_glb(character, toy.skeleton.names, toy.skeleton.parents, **options)
        builder.write(folder / f"{compact}.glb")
    return {compact: folder / f"{compact}.glb" for compact in (False, True)}


def test_vertices_differ_by_a_tenth_of_a_millimetre(files):
    exact, compact = GlbReader(files[False]), GlbReader(files[True])
    assert len(compact.binary) < 0.6 * len(exact.binary)
    for clip, frames in (("wave", (0, 5, 12)), ("stretched", (0, 3))):
        for frame in frames:
            a, b = (reader.vertices(clip, frame / FRAME_RATE) for reader in (exact, compact))
            assert 0 < np.linalg.norm(a - b, axis=1).max() < 2e-4  # metres, over a chain of 1.2 m; measured 7e-5


def test_directions_and_weights(files):
    exact, compact = GlbReader(files[False]), GlbReader(files[True])
    a, b = exact.attribute("NORMAL"), compact.attribute("NORMAL")
    assert np.degrees(np.arccos((np.sum(a * b, 1) / np.linalg.norm(b, axis=1)).clip(-1, 1))).max() < 0.5
    np.testing.assert_allclose(compact.dense_weights(), exact.dense_weights(), atol=3e-5)
    np.testing.assert_allclose(compact.dense_weights().sum(1), 1, atol=1e-12)


@needs_readers
def test_the_khronos_validator_has_no_complaints(files):
    issues = run_reader("validate.mjs", files[True])["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


@needs_readers
def test_three_js_shows_the_same_vertices(files):
    for clip, frame in (("wave", 5), ("stretched", 3)):
        found = np.array(run_reader("three.mjs", files[True], clip, frame / FRAME_RATE)["frames"][0])
        wanted = GlbReader(files[False]).vertices(clip, frame / FRAME_RATE)
        assert np.linalg.norm(found - wanted, axis=1).max() < 2e-4


def test_rows_of_weights_sum_to_one():
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([0.3] * 4, 500).astype(np.float32)
    stored = shares(weights)
    assert (stored.sum(1, dtype=np.int64) == 65535).all()
    np.testing.assert_allclose(stored / 65535, weights, atol=4e-5)


def test_numbers_outside_are_cut():
    assert signed_shares(np.array([-2.0, -1, 0, 1, 2])).tolist() == [-32767, -32767, 0, 32767, 32767]
    assert signed_bytes(np.array([-2.0, 0.5, 2])).tolist() == [-127, 64, 127]
