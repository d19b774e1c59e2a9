"""Generated files in CAPE's layout: registered meshes at the origin, damaged frames left out, a split by sequence."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from licensed_files import write_body, write_cape

from snarfcli.bodies import load_body
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import split_sequences
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings


def load(root: Path, subject: str = "00032_longshort", **config: object) -> SubjectData:
    """Load one subject as the command does, every second frame."""
    return find_dataset("cape").load(subject, Request(DataConfig("cape", 2, 2, 2, **config), root))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A data folder with one person in two outfits, and a body."""
    write_cape(tmp_path, outfits={"longshort": ("hips", "squat", "tilt"), "blazerlong": ("hips",)})
    write_body(tmp_path / "smpl")
    return tmp_path


def test_meshes_fit_the_bones(root: Path) -> None:
    subject = load(root)
    assert [(s.name, s.split) for s in subject.sequences] == [("hips", "train"), ("squat", "train"), ("tilt", "test")]
    hips = subject.sequences[0]
    np.testing.assert_array_equal(hips.frames, [0, 2, 4])
    vertices, faces = hips.meshes[2]
    assert vertices.shape == (6890, 3)
    assert faces.shape == (13776, 3)
    # at the origin: the pelvis is where forward kinematics without a translation puts it
    body = load_body(next((root / "smpl").iterdir()))
    posed = body.pose(torch.from_numpy(hips.motion.poses[2:3]))
    assert np.abs(vertices - posed.vertices[0].numpy()).max() < 1e-5  # float32 vertices of 1 m, moved there and back
    # the joints are the minimal body's, which is 2 % smaller
    torch.testing.assert_close(subject.skeleton.joints_rest, 0.98 * body.shaped()[1], rtol=1e-5, atol=1e-5)
    assert find_dataset("cape").subjects(Request(DataConfig("cape", 2, 2, 2), root)) == (
        "00032_blazerlong",
        "00032_longshort",
    )


def test_only_what_is_needed_of_a_file_is_read(root: Path) -> None:
    frame = root / "cape_release/sequences/00032/longshort_hips/longshort_hips.000001.npz"
    with np.load(frame) as arrays:
        content = dict(arrays)
    np.savez(frame, **content, notes=np.array([{"a": 1}], object))  # a pickle that must not be read
    np.testing.assert_array_equal(load(root).sequences[0].frames, [0, 2, 4])
    del content["transl"]
    np.savez(frame, **content)
    np.testing.assert_array_equal(load(root).sequences[0].frames, [2, 4])


def test_names_stay_inside_the_store(root: Path) -> None:
    folder = root / "cape_release" / "sequences" / "00032"
    for name in ("longshort_", "longshort_..", "blazerlong_."):
        (folder / name).mkdir()
    subject = load(root, test=["tilt"])
    assert {spec.name for spec in subject.sequences} | {name for name, _ in subject.broken} == {"clip", "hips", "squat", "tilt"}


def test_broken_frames_are_left_out(root: Path, caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    folder = root / "cape_release" / "sequences" / "00032"
    frame = folder / "longshort_hips" / "longshort_hips.000003.npz"
    frame.write_bytes(frame.read_bytes()[:-3000])
    for path in (folder / "longshort_squat").iterdir():
        path.write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        subject = load(root)
    np.testing.assert_array_equal(subject.sequences[0].frames, [0, 4])
    assert "hips: 1 of 3 frames cannot be read and are left out" in caplog.text
    assert "longshort_hips.000003.npz" in caplog.text
    assert [name for name, _ in subject.broken] == ["squat"]
    assert "longshort_squat.000001.npz" in subject.broken[0][1]
    sampling = SamplingSettings(points_per_frame=80, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    with pytest.raises(UserError, match=r"sequence squat cannot be used.*skip_broken=true"):
        preprocess_subject(subject, tmp_path / "out", sampling, {"train": 2, "test": 2, "ood": 2})
    preprocess_subject(subject, tmp_path / "out", sampling, {"train": 2, "test": 2, "ood": 2}, skip_broken=True)
    store = SampleStore.open(tmp_path / "out", "cape", "00032_longshort")
    np.testing.assert_array_equal(store.sequences("train")[0].frame_numbers, [0, 4])
    assert store.manifest["skipped"][0]["name"] == "squat"


def test_what_is_missing_is_named(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(UserError, match="subject 32: wanted one outfit, got 00032_blazerlong, 00032_longshort; name one"):
        load(root, "32")
    with pytest.raises(UserError, match="no CAPE subject '00033_longshort'; did you mean '00032_longshort'"):
        load(root, "00033_longshort")
    with pytest.raises(UserError, match="no sequence is left to train on"):
        load(root, test=["*"])
    with pytest.raises(UserError, match=r"no cape_release/sequences .* below"):
        load(tmp_path_factory.mktemp("empty"))
    minimal = root / "cape_release" / "minimal_body_shape" / "00032" / "00032_minimal.npy"
    np.save(minimal, np.zeros((10, 3)))
    with pytest.raises(UserError, match=r"00032_minimal.npy: wanted finite numbers of shape \[6890, 3\], got \[10, 3\]"):
        load(root)
    (root / "cape_release" / "misc" / "subj_genders.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(UserError, match=r"subj_genders.pkl"):
        load(root)


@pytest.mark.parametrize(
    ("test", "ood", "wanted"),
    [
        ([], [], {"a": "train", "b": "train", "c": "test", "ood_d": "ood"}),
        (["a"], [], {"a": "test", "b": "train", "c": "train", "ood_d": "ood"}),
        (["a"], ["c"], {"a": "test", "b": "train", "c": "ood", "ood_d": "train"}),
        (["?"], ["a"], {"a": "ood", "b": "test", "c": "test", "ood_d": "train"}),
    ],
)
def test_sequences_are_held_out(test: list[str], ood: list[str], wanted: dict[str, str]) -> None:
    assert split_sequences(("a", "b", "c", "ood_d"), test, ood) == wanted
    with pytest.raises(UserError, match="no sequence 'x'"):
        split_sequences(("a",), ["x"], [])
