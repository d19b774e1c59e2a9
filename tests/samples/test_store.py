"""The store of samples: what is written is read back, and damage is named."""

from __future__ import annotations

import errno
import json
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from snarfcli.cli.messages import user_message
from snarfcli.errors import UserError
from snarfcli.samples.layout import FORMAT_VERSION, samples_folder
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.samples.writing import (
    SequenceWriter,
    discard_samples,
    remove_leftovers,
    require_same_settings,
    settings_digest,
    write_arrays,
    write_manifest,
)
from snarfcli.sampling import FrameSamples, dequantise, unpack_vertices

_POINTS = 48
_SETTINGS = {"seed": 0, "points_per_frame": _POINTS}


def _frame(seed: int) -> FrameSamples:
    generator = np.random.default_rng(seed)
    cells = generator.integers(0, 65536, (_POINTS, 3)).astype(np.uint16)
    lower = generator.normal(size=3).astype(np.float32)
    corners = 4 + seed % 3 if seed % 2 else 4  # some frames have another mesh
    return FrameSamples(
        points=cells,
        occupied=generator.random(_POINTS) < 0.3,
        vertices=generator.integers(0, 2**63, corners).astype(np.uint64),
        faces=np.arange(3 * corners, dtype=np.int32).reshape(-1, 3) % corners,
        cube_lower=lower,
        cube_size=np.float32(1 + seed),
        box_lower=lower,
        box_upper=lower + np.float32(seed),
        boundary_edges=corners - 4,
        differing=seed % 2,
    )


def _arrays(frames: int) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(frames)
    shapes = {
        "poses": (2, 3), "translation": (3,), "posed_from_canonical": (2, 4, 4), "joints": (2, 3),
    }  # fmt: skip
    arrays = {name: generator.normal(size=(frames, *shape)).astype(np.float32) for name, shape in shapes.items()}
    return {**arrays, "frame_numbers": np.arange(frames) * 4}


def _write(root: Path, lengths: dict[tuple[str, str], int]) -> Path:
    folder = samples_folder(root, "builtin", "toy")
    entries = []
    for (split, name), frames in lengths.items():
        writer = SequenceWriter(folder / split / name, frames, _POINTS)
        for frame in reversed(range(frames)):
            writer.write_frame(frame, _frame(frame))
        description = {"name": name, "split": split, "frame_rate": 60.0, "settings": _SETTINGS}
        entries.append(writer.finish(_arrays(frames), description))
    arrays = {
        "names": np.array(["root", "middle"]),
        "parents": np.array([-1, 0], np.int32),
        "joints_rest": np.zeros((2, 3), np.float32),
        "canonical_pose": np.zeros((2, 3), np.float32),
        "faces": np.zeros((4, 3), np.int32),
        "vertices_canonical": np.ones((5, 3), np.float32),
        "vertex_weights": np.full((5, 2), 0.5, np.float32),
        "betas": np.zeros(1, np.float32),
    }
    write_arrays(folder / "subject.npz", arrays)
    write_manifest(folder, {"data": "builtin", "subject": "toy", "settings": _SETTINGS}, entries)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return _write(tmp_path, {("train", "walk"): 20, ("train", "run"): 3, ("test", "hop"): 2})


def _open(folder: Path) -> SampleStore:
    return SampleStore.open(folder.parents[2], "builtin", "toy")


def test_points_and_labels_come_back(folder: Path) -> None:
    walk = _open(folder).sequences("train")[0]
    assert (walk.num_frames, walk.num_points, walk.num_uniform) == (20, _POINTS, _POINTS // 2)
    for frame in (0, 19):
        made = _frame(frame)
        wanted = dequantise(made.points, made.cube_lower, made.cube_size)
        points, labels = walk.points(frame), walk.occupancies(frame)
        assert points.dtype == np.float32
        assert labels.dtype == bool
        np.testing.assert_array_equal(points, wanted)  # bit for bit: labels were made for these
        np.testing.assert_array_equal(labels, made.occupied)
        lower, upper = walk.cube(frame)
        assert (points >= lower).all()
        assert (points <= upper).all()
    assert walk.points(np.arange(3)).shape == (3, _POINTS, 3)
    assert walk.occupancies(np.arange(3)).shape == (3, _POINTS)


@pytest.mark.parametrize("frames", [7, np.int64(7), [7], [3, 3, 19]], ids=str)
def test_chosen_points_equal_those_of_all(folder: Path, frames: int | list[int]) -> None:
    walk = _open(folder).sequences("train")[0]
    generator = np.random.default_rng(0)
    for shape in ((11,), (*np.shape(frames), 11)):
        index = generator.integers(0, _POINTS, shape)
        each = np.broadcast_to(index, (*np.shape(frames), 11))
        points = np.take_along_axis(walk.points(frames), each[..., None], -2)
        np.testing.assert_array_equal(walk.points(frames, index), points)
        labels = np.take_along_axis(walk.occupancies(frames), each, -1)
        np.testing.assert_array_equal(walk.occupancies(frames, index), labels)
    assert walk.points(frames, np.zeros(0, int)).shape == (*np.shape(frames), 0, 3)


def test_the_rest_comes_back(folder: Path) -> None:
    store = _open(folder)
    walk, arrays = store.sequences("train")[0], _arrays(20)
    np.testing.assert_array_equal(walk.poses, arrays["poses"])
    np.testing.assert_array_equal(walk.bone_transforms, arrays["posed_from_canonical"])
    np.testing.assert_array_equal(walk.joints, arrays["joints"])
    for frame in (0, 1, 4, 5, 19):
        made = _frame(frame)
        wanted = unpack_vertices(made.vertices, made.cube_lower, made.cube_size)
        np.testing.assert_array_equal(walk.vertices(frame), wanted)
        np.testing.assert_array_equal(walk.faces(frame), made.faces)
        np.testing.assert_array_equal(walk.box(frame), (made.box_lower, made.box_upper))
    assert walk.description["boundary_edges"] == 2
    assert np.load(folder / "train" / "walk" / "faces.npy").shape == (4 + 5 + 6, 3)  # each topology once
    assert store.skeleton.names == ("root", "middle")
    assert store.skeleton.parents == (-1, 0)
    assert store.template.faces.shape == (4, 3)
    assert store.template.vertices.shape == (5, 3)
    assert store.template.weights.shape == (5, 2)
    assert [sequence.name for sequence in store.sequences("test")] == ["hop"]


def test_scans_with_faces_of_their_own_take_no_memory(tmp_path: Path) -> None:
    frames, faces = 30, np.zeros((20_000, 3), np.int32)
    made = replace(_frame(0), vertices=np.zeros(frames, np.uint64))
    writer = SequenceWriter(tmp_path / "scans", frames, _POINTS)
    tracemalloc.start()
    try:
        for frame in range(frames):
            writer.write_frame(frame, replace(made, faces=faces + frame))
        entry = writer.finish(_arrays(frames), {"name": "scans", "split": "train", "frame_rate": 30.0, "settings": _SETTINGS})
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 12 * faces.nbytes  # measured 8.8, blocks of 1 MiB for the checksum; all faces would be 30
    scans = SequenceSamples(tmp_path / "scans", entry)
    for frame in (0, 7, 29):
        np.testing.assert_array_equal(scans.faces(frame), faces + frame)


def test_validation_is_the_last_tenth_of_training_sequences(folder: Path) -> None:
    store = _open(folder)
    walk, run = store.sequences("train")
    np.testing.assert_array_equal(walk.train_frames, np.arange(18))
    np.testing.assert_array_equal(walk.val_frames, [18, 19])
    np.testing.assert_array_equal(run.val_frames, [2])
    hop = store.sequences("test")[0]
    assert len(hop.train_frames) == len(hop.val_frames) == 0


def test_a_single_frame_is_for_training(tmp_path: Path) -> None:
    (one,) = _open(_write(tmp_path, {("train", "walk"): 1})).sequences("train")
    np.testing.assert_array_equal(one.train_frames, [0])
    assert len(one.val_frames) == 0


def test_manifest_says_what_is_there(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["format_version"] == FORMAT_VERSION
    assert manifest["settings"] == _SETTINGS
    assert manifest["settings_digest"] == settings_digest(_SETTINGS)
    assert manifest["frames"] == {"train": 23, "test": 2, "ood": 0}
    assert manifest["points"] == 25 * _POINTS
    files = list(folder.rglob("*.np?"))
    assert manifest["bytes"] == sum(path.stat().st_size for path in files)
    inside = sum(_frame(f).occupied.sum() for n in (20, 3, 2) for f in range(n))
    assert manifest["inside_share"] == pytest.approx(inside / manifest["points"])
    assert manifest["self_intersecting_share"] == pytest.approx((10 + 1 + 1) / manifest["points"])
    occupancies = folder / "train" / "walk" / "occupancies.npy"
    assert occupancies.stat().st_size == 128 + 20 * _POINTS // 8  # one bit a point


def test_missing_and_unfinished_samples_name_the_command(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r'no samples of subject 50002 under .*builtin; run "snarf preprocess'):
        SampleStore.open(tmp_path, "builtin", "50002")
    (folder / "manifest.json").unlink()
    begun = r'unfinished; run "snarf preprocess data=builtin subject=toy data_root=.*", with the settings it began with'
    with pytest.raises(UserError, match=begun):
        _open(folder)


def test_unknown_and_empty_splits(folder: Path) -> None:
    store = _open(folder)
    with pytest.raises(UserError, match="no sequence of split ood"):
        store.sequences("ood")
    with pytest.raises(ValueError, match="did you mean 'train'"):
        store.sequences("trian")


@pytest.mark.parametrize(("version", "told"), [(0, "0"), (FORMAT_VERSION + 1, "3"), (None, "none"), ("${x}", "none")])
def test_another_format_version_is_refused(folder: Path, version: int | str | None, told: str) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format_version": version}))
    with pytest.raises(UserError, match=rf"wanted format version {FORMAT_VERSION}, got {told};.*overwrite=true"):
        _open(folder)
    with pytest.raises(UserError, match="format"):
        require_same_settings(folder, _SETTINGS)


@pytest.mark.parametrize("name", ["train/walk/points.npy", "train/walk/frames.npz", "test/hop/occupancies.npy", "subject.npz"])
def test_damage_is_named(folder: Path, name: str) -> None:
    path = folder / name
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(UserError, match=f"damaged: .*{name}.* bytes"):
        _open(folder)
    path.unlink()
    with pytest.raises(UserError, match=f"damaged: .*{name} is missing"):
        _open(folder)
    path.write_bytes(content[:-40] + bytes(1) * 40)
    with pytest.raises(UserError, match=f"{name}.*(is not an .npz archive|is damaged|checksum differs)"):
        _open(folder).verify()
    path.write_bytes(content)
    _open(folder).verify()


def test_an_unfinished_sequence_leaves_nothing(tmp_path: Path) -> None:
    folder = samples_folder(tmp_path, "builtin", "toy")
    writer = SequenceWriter(folder / "train" / "walk", 2, _POINTS)
    writer.write_frame(1, _frame(1))
    assert not (folder / "train" / "walk").exists()
    writer.discard()
    assert not list(folder.rglob("*.npy"))
    SequenceWriter(folder / "train" / "walk", 2, _POINTS)  # as if killed: never discarded
    remove_leftovers(folder)
    assert not folder.exists()


def test_other_settings_are_named(folder: Path) -> None:
    require_same_settings(folder, _SETTINGS)
    for _ in range(2):  # by the manifest, then by the sequences of an unfinished run
        with pytest.raises(UserError, match=r"other settings \(seed 0 -> 1, padding unset -> 0.2\).*overwrite=true"):
            require_same_settings(folder, {**_SETTINGS, "seed": 1, "padding": 0.2})
        (folder / "manifest.json").unlink(missing_ok=True)


def test_discarding_spares_what_is_not_ours(folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    discard_samples(folder)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("number", [errno.EACCES, errno.EMFILE, errno.EIO])
@pytest.mark.parametrize("name", ["frames.npz", "points.npy"])
def test_errors_of_the_system_are_not_damage(folder: Path, number: int, name: str, monkeypatch) -> None:
    def failing(path: Path, *arguments, **more):
        if path.name == name:
            raise OSError(number, os.strerror(number), str(path))
        return opened(path, *arguments, **more)

    opened = Path.open
    monkeypatch.setattr(Path, "open", failing)
    with pytest.raises(OSError, match=os.strerror(number)) as caught:
        _open(folder)
    assert name in caught.value.filename
    message = user_message(caught.value)
    assert "delete" not in message
    assert "overwrite" not in message


def test_frames_in_another_order_are_damage(folder: Path) -> None:
    path = folder / "test" / "hop" / "frames.npz"
    arrays = dict(np.load(path))
    arrays["frame_numbers"] = arrays["frame_numbers"][::-1].copy()
    write_arrays(path, arrays)
    manifest = json.loads((folder / "manifest.json").read_text())
    for sequence in manifest["sequences"]:
        if sequence["name"] == "hop":
            sequence["files"]["frames.npz"]["bytes"] = path.stat().st_size
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=r"the samples are damaged: .*frames\.npz: frame_numbers: wanted rising numbers"):
        _open(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["sequences"][0].update(name="../../../etc"), r"sequences\[0\]\.name: wanted the name of a folder"),
        (lambda m: m["sequences"][0].update(split="all"), r"sequences\[0\]\.split: wanted one of train, test, ood"),
        (lambda m: m["sequences"][0].update(frames=-1), r"sequences\[0\]: wanted frames of a multiple of 8 points"),
        (lambda m: m["sequences"][0].update(frame_rate="fast"), r"sequences\[0\]\.frame_rate: wanted a number, got 'fast'"),
        (lambda m: m["sequences"].append(m["sequences"][0]), "wanted different sequences, at least one"),
        (lambda m: m["files"].update({"../x": m["files"]["subject.npz"]}), r"files: wanted subject\.npz, got other names"),
        (lambda m: m.update(subject="\x1b[2J"), r"subject: wanted a short printable name"),
        (lambda m: m.pop("sequences"), r"sequences: wanted a value, got none"),
    ],
)
def test_a_damaged_manifest_is_named(folder: Path, change, message: str) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=f"are damaged: .*{message}") as caught:
        _open(folder)
    assert str(caught.value).isprintable()
