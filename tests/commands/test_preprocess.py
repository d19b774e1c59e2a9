"""`snarf preprocess` end to end on a bending capsule."""

from __future__ import annotations

import errno
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from failing_meshes import FailingMeshes
from toy_subject import toy_body, toy_subject

from snarfcli.commands import preprocess
from snarfcli.commands.preprocess import PreprocessConfig
from snarfcli.datasets.posed_meshes import FileMeshes
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError
from snarfcli.formats.surfaces import read_surface
from snarfcli.samples.store import SampleStore
from snarfcli.samples.writing import SequenceWriter
from snarfcli.sampling import occupancies


@pytest.fixture
def subject(monkeypatch: pytest.MonkeyPatch) -> list[SubjectData]:
    """Make the toy the only subject; a test can replace it."""
    holder = [toy_subject()]

    def load(name: str, request: Request) -> SubjectData:
        if name != "toy":
            raise UserError(f"no built-in subject '{name}'")
        return holder[0]

    monkeypatch.setattr("snarfcli.datasets.builtin.load", load)
    return holder


def _config(root: Path, **changes: Any) -> PreprocessConfig:
    return PreprocessConfig(**{
        "subject": "toy", "data": DataConfig("builtin", 1, 1, 1), "data_root": str(root), "points_per_frame": 400,
        "surface_noise_m": 0.01, "padding": 0.1, "inside_test": "winding", "poisson": "auto", "workers": 1, "seed": 0,
        "overwrite": False, "sequences": [], "skip_broken": False, "body": None, **changes,
    })  # fmt: skip


def _contents(root: Path) -> dict[str, bytes]:
    folder = root / "processed" / "builtin" / "toy"
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_samples_do_not_depend_on_workers_or_interruptions(
    tmp_path: Path, subject: list[SubjectData], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    one, two = tmp_path / "one", tmp_path / "two"
    preprocess.run(_config(one))
    assert "39 frames, 15600 samples in" in caplog.text
    assert "samples/s" in caplog.text
    assert "bytes per frame" in caplog.text
    assert "give different labels to 0.000 % of the points" in caplog.text
    preprocess.run(_config(two, sequences=["fold"], workers=2))
    assert [entry["name"] for entry in json.loads(_contents(two)["manifest.json"])["sequences"]] == ["fold"]
    caplog.clear()
    preprocess.run(_config(two, workers=0))
    assert "1 of 3 sequences existed already" in caplog.text
    assert _contents(one) == _contents(two)

    store = SampleStore.open(one, "builtin", "toy")
    store.verify()
    bend = store.sequences("train")[0]
    assert bend.num_frames == 34  # two tasks
    assert len({bend.points(frame).tobytes() for frame in range(34)}) == 34
    for frame in (0, 30, 33):
        points = bend.points(frame)
        mesh = subject[0].sequences[0].meshes[frame]
        np.testing.assert_array_equal(bend.faces(frame), mesh[1])
        np.testing.assert_array_equal(bend.occupancies(frame), occupancies(*mesh, points))
        np.testing.assert_array_equal(bend.box(frame)[0], mesh[0].min(0))
        np.testing.assert_allclose(bend.vertices(frame), mesh[0], atol=5e-7)  # metres
    # the bone transforms move the canonical mesh and joints onto the posed ones
    weights, canonical = store.template.weights, np.pad(store.template.vertices, ((0, 0), (0, 1)), constant_values=1)
    posed = np.einsum("vj,tjrc,vc->tvr", weights, bend.bone_transforms[:, :, :3], canonical)
    np.testing.assert_allclose(posed[8], subject[0].sequences[0].meshes[8][0], atol=2e-6)  # fp32 transforms of 1 m
    joints = torch.cat([store.skeleton.canonical_joints, torch.ones(2, 1)], 1).numpy()
    moved = np.einsum("tjrc,jc->tjr", bend.bone_transforms[:, :, :3], joints)
    np.testing.assert_allclose(moved, bend.joints, atol=2e-6)

    before = _contents(one)
    preprocess.run(_config(one))
    assert _contents(one) == before


def test_settings_are_not_mixed(tmp_path: Path, subject: list[SubjectData]) -> None:
    few = {"sequences": ["fold"]}
    preprocess.run(_config(tmp_path, **few))
    before = _contents(tmp_path)
    with pytest.raises(UserError, match=r"other settings \(padding 0.1 -> 0.3, seed 0 -> 5\).*overwrite=true"):
        preprocess.run(_config(tmp_path, seed=5, padding=0.3, **few))
    with pytest.raises(UserError, match=r"other settings \(poisson unset -> own\)"):
        preprocess.run(_config(tmp_path, poisson="own", **few))
    with pytest.raises(UserError, match="train_frame_step 1 -> 2"):
        preprocess.run(_config(tmp_path, data=DataConfig("builtin", 2, 1, 1), **few))
    subject[0] = toy_subject()
    subject[0].sequences[2].motion.poses[0, 1, 0] += 0.1
    with pytest.raises(UserError, match=r"fold was made from another motion \(poses differs\)"):
        preprocess.run(_config(tmp_path, **few))
    body = toy_body()
    subject[0] = toy_subject(body=replace(body, v_template=body.v_template * 1.1))
    with pytest.raises(UserError, match="made from another body"):
        preprocess.run(_config(tmp_path, **few))
    assert _contents(tmp_path) == before
    preprocess.run(_config(tmp_path, overwrite=True, seed=5, inside_test="parity", **few))
    manifest = json.loads(_contents(tmp_path)["manifest.json"])
    assert manifest["settings"]["seed"] == 5
    assert manifest["settings"]["inside_test"] == "parity"
    assert _contents(tmp_path)["ood/fold/points.npy"] != before["ood/fold/points.npy"]


@pytest.mark.parametrize("problem", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_an_interrupted_run_leaves_whole_sequences_only(
    tmp_path: Path, subject: list[SubjectData], monkeypatch: pytest.MonkeyPatch, problem: BaseException
) -> None:
    write = SequenceWriter.write_frame

    def stop_at_fold(self: SequenceWriter, frame: int, samples: Any) -> None:
        if self.folder.name == "fold":
            raise problem
        write(self, frame, samples)

    with monkeypatch.context() as patch:
        patch.setattr(SequenceWriter, "write_frame", stop_at_fold)
        with pytest.raises(type(problem)):
            preprocess.run(_config(tmp_path, sequences=["wave", "fold"]))
    assert {name.split("/")[1] for name in _contents(tmp_path) if "/" in name} == {"wave"}
    assert not [path for path in tmp_path.rglob(".*") if path.suffix != ".lock"]
    with pytest.raises(UserError, match="unfinished"):
        SampleStore.open(tmp_path, "builtin", "toy")
    preprocess.run(_config(tmp_path, sequences=["wave", "fold"]))
    assert len(SampleStore.open(tmp_path, "builtin", "toy").manifest["sequences"]) == 2


def test_a_damaged_sequence_is_made_again(tmp_path: Path, subject: list[SubjectData]) -> None:
    few = {"sequences": ["fold"]}
    preprocess.run(_config(tmp_path, **few))
    before = _contents(tmp_path)
    folder = tmp_path / "processed" / "builtin" / "toy"
    place = folder / "ood" / "fold"
    entry = json.loads((place / "sequence.json").read_text())
    for name, content in {
        "points.npy": before["ood/fold/points.npy"][:-10],
        "frames.npz": bytes(len(before["ood/fold/frames.npz"])),
        "sequence.json": json.dumps({**entry, "files": 3}).encode(),
        "./sequence.json": json.dumps({name: entry[name] for name in ("format_version", "settings")}).encode(),
    }.items():
        (place / name).write_bytes(content)
        preprocess.run(_config(tmp_path, **few))
        assert _contents(tmp_path) == before
    (folder / "subject.npz").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"damaged: .*subject.npz cannot be read; start again with overwrite=true"):
        preprocess.run(_config(tmp_path, **few))


def test_an_open_mesh_is_said_once(tmp_path: Path, subject: list[SubjectData], caplog: pytest.LogCaptureFixture) -> None:
    body = toy_body()
    subject[0] = toy_subject(body=replace(body, faces=body.faces[1:]))
    few = {"sequences": ["fold"]}
    preprocess.run(_config(tmp_path, **few))
    assert caplog.text.count("is open, 3 boundary edges: labelled by winding number") == 1
    assert SampleStore.open(tmp_path, "builtin", "toy").manifest["sequences"][0]["boundary_edges"] == 3
    with pytest.raises(UserError, match=r"is open \(3 boundary edges\).*inside_test=winding"):
        preprocess.run(_config(tmp_path / "other", inside_test="parity", **few))
    assert not _contents(tmp_path / "other")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"subject": "tot"}, "no built-in subject 'tot'"),
        ({"data": DataConfig("biultin", 1, 1, 1)}, "no data set 'biultin'; did you mean 'builtin'"),
        ({"data": DataConfig("builtin", 0, 1, 1)}, "wanted a frame step of at least 1 for train sequences, got 0"),
        ({"sequences": ["bnd"]}, "no sequence 'bnd'; did you mean 'bend'"),
        ({"workers": -1}, "workers: wanted"),
        ({"points_per_frame": 30}, "multiple of 8"),
        ({"inside_test": "rays"}, "inside_test"),
    ],
)
def test_bad_values_make_nothing(tmp_path: Path, subject: list[SubjectData], changes: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        preprocess.run(_config(tmp_path, **changes))
    assert not list(tmp_path.iterdir())


def test_bad_poses_are_named(tmp_path: Path, subject: list[SubjectData]) -> None:
    subject[0].sequences[1].motion.poses[2, 0, 1] = np.nan
    with pytest.raises(UserError, match="wave: poses: wanted finite numbers, got NaN or infinity in frame 2"):
        preprocess.run(_config(tmp_path, sequences=["wave"]))
    assert not _contents(tmp_path)


def test_a_folder_that_cannot_be_made_is_an_os_error(tmp_path: Path, subject: list[SubjectData]) -> None:
    (tmp_path / "processed").write_text("a file in the way")
    with pytest.raises(OSError, match="processed"):
        preprocess.run(_config(tmp_path))


def test_a_broken_sequence_stops_the_run_or_is_left_out(
    tmp_path: Path, subject: list[SubjectData], caplog: pytest.LogCaptureFixture
) -> None:
    train, wave, fold = subject[0].sequences
    broken = replace(train, meshes=FailingMeshes(train.meshes, 31))  # in the second task of the sequence
    subject[0] = replace(subject[0], sequences=(wave, broken, fold), broken=(("lost", "lost.npz is truncated"),))
    with pytest.raises(UserError, match=r"sequence lost cannot be used: lost.npz is truncated; give skip_broken=true"):
        preprocess.run(_config(tmp_path))
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match=r"mesh 000031.obj is damaged; give skip_broken=true"):
        preprocess.run(_config(tmp_path, sequences=["wave", "bend"]))
    assert {name.split("/")[1] for name in _contents(tmp_path) if "/" in name} == {"wave"}  # complete sequences are kept
    preprocess.run(_config(tmp_path, skip_broken=True, workers=2))
    store = SampleStore.open(tmp_path, "builtin", "toy")
    assert [(entry["split"], entry["name"]) for entry in store.manifest["sequences"]] == [("test", "wave"), ("ood", "fold")]
    assert store.manifest["skipped"] == [
        {"name": "lost", "reason": "lost.npz is truncated"},
        {"name": "bend", "reason": "mesh 000031.obj is damaged"},
    ]
    assert "left out: sequence lost (lost.npz is truncated)" in caplog.text
    assert "left out: sequence bend (mesh 000031.obj is damaged)" in caplog.text
    assert not [path for path in tmp_path.rglob(".*") if path.suffix != ".lock"]


def test_files_are_read_before_anything_is_lost(
    tmp_path: Path, subject: list[SubjectData], caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    specs = []
    for spec in subject[0].sequences[1:]:
        paths = []
        for frame in range(len(spec.meshes)):
            paths.append(folder / f"{spec.name}_{frame}.ply")
            trimesh.Trimesh(*spec.meshes[frame], process=False).export(paths[-1])
        specs.append(replace(spec, meshes=FileMeshes(paths, read_surface, np.eye(4))))
    subject[0] = replace(subject[0], sequences=tuple(specs))
    data = tmp_path / "data"
    preprocess.run(_config(data))
    before = _contents(data)
    last = folder / "fold_1.ply"
    last.write_bytes(last.read_bytes()[:-100])
    with pytest.raises(UserError, match=r"fold_1\.ply.*; give skip_broken=true"):
        preprocess.run(_config(data, overwrite=True))
    assert _contents(data) == before  # existing samples are unchanged
    with pytest.raises(UserError, match=r"fold was made from other meshes .* delete it to make it again"):
        preprocess.run(_config(data))
    preprocess.run(_config(data, overwrite=True, skip_broken=True))
    manifest = json.loads(_contents(data)["manifest.json"])
    assert [entry["name"] for entry in manifest["sequences"]] == ["wave"]
    assert [entry["name"] for entry in manifest["skipped"]] == ["fold"]
    assert "left out: sequence fold" in caplog.text
    assert "fold_1.ply" in caplog.text
