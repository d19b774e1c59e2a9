"""`snarf fit` on scans of the built-in body; most tests replace searches by short ones, and processes by calls."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from toy_animal import animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_meshes
from toy_scans import BETAS, QuickFinder, joint_error_mm, toy_mesh, toy_poses, write_scans

from snarfcli.commands import fit
from snarfcli.commands.fit import FitConfig
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.output_locks import hold_output
from snarfcli.sampling import oriented_surface_samples
from snarfcli.scanned_subjects import fit_figure, fitter, subject_fit, subject_scans, subject_shape

ACCURATE_MM = 10.0  # measured 3 to 6, with 300 vertices and 1,000 points


def _in_process(
    function: Callable[..., Iterable[Any]], tasks: Iterable[tuple[Any, ...]], workers: int
) -> Iterator[tuple[int, Any]]:
    for number, task in enumerate(tasks):
        for item in function(*task):
            yield number, item


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Fit with few vertices, in this process, from poses that are nearly right."""
    monkeypatch.setattr(fitter, "PoseFinder", QuickFinder)
    monkeypatch.setattr(fitter, "_VERTICES", 300)
    monkeypatch.setattr(subject_shape, "_FRAMES", 3)
    monkeypatch.setattr(fit_figure, "_PANEL", 32)
    monkeypatch.setattr(fit_figure, "_ROWS", 1)
    for module in (subject_scans, subject_shape, subject_fit):
        monkeypatch.setattr(module, "run_in_processes", _in_process)
    return monkeypatch


def _config(root: Path, **changes: Any) -> FitConfig:
    data = {name: changes.pop(name) for name in ("scale", "up", "folder") if name in changes}
    return FitConfig(**{
        "subject": "me", "data": DataConfig("meshes", 1, 1, 1, **data), "data_root": str(root), "body": None, "skeleton": None,
        "gender": "neutral", "clothes": "false", "points_per_frame": 1000, "ordered": "auto", "frame_rate": 30.0,
        "workers": 1, "seed": 0, "overwrite": False, "skip_broken": False, **changes,
    })  # fmt: skip


def _files(place: Path) -> set[str]:
    """Return the files beside the scans, without locks."""
    found = (path for path in place.rglob("*") if path.is_file() and path.suffix not in (".ply", ".lock"))
    return {path.relative_to(place).as_posix() for path in found}


@pytest.fixture
def me(tmp_path: Path) -> Path:
    """Folder of a subject with two sequences."""
    place = tmp_path / "meshes" / "me"
    write_scans(place / "run", 2, phase=1.0)
    write_scans(place / "walk", 3)
    return place


def test_sequences_are_fitted_written_and_reported(
    tmp_path: Path, me: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    assert fit.run(_config(tmp_path)) == 0
    assert _files(me) == {"skeleton.npz", "fit.json", "fit.png", "run/poses.npz", "walk/poses.npz"}
    errors = joint_error_mm(me, {"run": toy_poses(2, 1.0), "walk": toy_poses(3)})
    assert max(errors.values()) < ACCURATE_MM
    report = json.loads((me / "fit.json").read_text())
    assert report["complete"] is True
    assert [(entry["name"], entry["frames"], entry["not_trusted"]) for entry in report["sequences"]] == [
        ("run", 2, 0),
        ("walk", 3, 0),
    ]
    assert len(report["sequences"][1]["residual_mm_per_frame"]) == 3
    assert report["settings"]["points_per_frame"] == 1000
    for line in ("2 sequences, 5 frames; the built-in body", "the files are in m", "walk: 3 frames", "all trusted", "next: "):
        assert line in caplog.text

    before = {name: (me / name).read_bytes() for name in ("run/poses.npz", "skeleton.npz")}
    caplog.clear()
    fit.run(_config(tmp_path))
    assert "2 of 2 sequences fitted already" in caplog.text
    assert {name: (me / name).read_bytes() for name in before} == before
    with pytest.raises(UserError, match=r"fitted with other settings \(seed 0 -> 5\).*overwrite=true"):
        fit.run(_config(tmp_path, seed=5))
    data = find_dataset("meshes").load("me", Request(DataConfig("meshes", 1, 1, 1), tmp_path))
    assert {spec.name for spec in data.sequences} == {"run", "walk"}
    assert not data.broken


def test_meshes_with_the_vertices_of_the_body_are_fitted_exactly(tmp_path: Path, quick: pytest.MonkeyPatch) -> None:
    place = tmp_path / "meshes" / "me"
    truth = {
        "run": write_scans(place / "run", 2, phase=1.0, unit_m=0.01, up="z", one_topology=True),
        "walk": write_scans(place / "walk", 3, unit_m=0.01, up="z", one_topology=True),
    }
    fit.run(_config(tmp_path))
    errors = joint_error_mm(place, truth)
    assert max(errors.values()) < 0.5  # measured 0.03


def test_points_without_normals_are_fitted(tmp_path: Path, quick: pytest.MonkeyPatch) -> None:
    place = tmp_path / "meshes" / "me" / "walk"
    place.mkdir(parents=True)
    poses, places = toy_poses(2)
    for frame in range(2):
        vertices, faces = toy_mesh(poses[frame], places[frame])
        points, _ = oriented_surface_samples(vertices, faces, 1200, np.random.default_rng(frame))
        np.savetxt(place / f"{frame}.xyz", 100 * points)
    fit.run(_config(tmp_path))
    assert joint_error_mm(place.parent, {"walk": (poses, places)})["walk"] < ACCURATE_MM
    fit.run(_config(tmp_path))  # its own poses.npz is no scan


def test_a_rig_is_fitted_in_place_of_a_body(
    tmp_path: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    animal, motion = make_animal(0.06), animal_motion("trot", 3)
    (tmp_path / "animal.glb").write_bytes(animal_glb(animal, [motion]))
    write_animal_meshes(tmp_path / "meshes" / "me", animal, [motion])
    config = _config(tmp_path, skeleton=str(tmp_path / "animal.glb"), frame_rate=24.0)
    for path in (tmp_path / "meshes" / "me").rglob("*.*"):
        if path.suffix != ".obj":
            path.unlink()
    fit.run(config)
    data = find_dataset("meshes").load("me", Request(config.data, tmp_path))
    assert data.skeleton.names == animal.names
    assert "rig" in caplog.text
    moved = data.sequences[0].motion.poses
    assert moved.shape[1:] == (len(animal.names), 3)
    arrays = np.load(tmp_path / "meshes" / "me" / "trot" / "poses.npz")
    assert arrays["residual_m"].max() < 0.002
    assert arrays["trusted"].all()


def test_units_axes_and_a_floor_are_found_once_for_all(
    tmp_path: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    place = tmp_path / "meshes" / "me"
    truth = {"walk": write_scans(place / "walk", 3, unit_m=0.001, up="z")}
    corners = 1000 * np.array([[-1.5, 1.5, 0], [1.5, 1.5, 0], [1.5, -1.5, 0], [-1.5, -1.5, 0]])
    for path in (place / "walk").iterdir():
        mesh = trimesh.load_mesh(path, process=False)
        ground = trimesh.Trimesh(corners + np.array([0, 0, mesh.vertices[:, 2].min()]), [[0, 2, 1], [0, 3, 2]])
        trimesh.util.concatenate([mesh, ground]).export(path)
    fit.run(_config(tmp_path, points_per_frame=1500))
    for line in ("the files are in mm", "up axis z: the scans show a floor", "left out: a floor, in walk"):
        assert line in caplog.text
    assert joint_error_mm(place, truth)["walk"] < 15  # without soles


def test_an_interrupted_fit_goes_on(
    tmp_path: Path, me: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    write = subject_fit.write_fitted

    def stop_at_walk(folder: Path, *arguments: Any) -> None:
        if folder.name == "walk":
            raise KeyboardInterrupt
        write(folder, *arguments)

    with quick.context() as patch:
        patch.setattr(subject_fit, "write_fitted", stop_at_walk)
        with pytest.raises(KeyboardInterrupt):
            fit.run(_config(tmp_path))
    assert "finished sequences are kept; run the same command to continue" in caplog.text
    assert _files(me) == {"skeleton.npz", "fit.json", "run/poses.npz"}
    assert json.loads((me / "fit.json").read_text())["complete"] is False
    skeleton, run = (me / "skeleton.npz").read_bytes(), (me / "run" / "poses.npz").read_bytes()
    fit.run(_config(tmp_path))
    assert "1 of 2 sequences fitted already" in caplog.text
    assert ((me / "skeleton.npz").read_bytes(), (me / "run" / "poses.npz").read_bytes()) == (skeleton, run)
    assert (me / "walk" / "poses.npz").is_file()
    caplog.clear()
    (me / "run" / "1.ply").unlink()  # its scans have changed
    fit.run(_config(tmp_path))
    assert "1 of 2 sequences fitted already" in caplog.text
    assert "run: 1 frame" in caplog.text
    assert "the scans of 1 sequence have changed, such as run" in caplog.text
    assert "kept from earlier scans" not in caplog.text


def test_scans_that_all_changed_are_told(
    tmp_path: Path, me: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fit.run(_config(tmp_path))
    for path in me.rglob("*.ply"):
        content = bytearray(path.read_bytes())
        content[content.index(b"end_header") + 11] ^= 1  # a coordinate; the size is the same
        path.write_bytes(content)
    assert fit.run(_config(tmp_path)) == 0
    assert "shape and unit are kept from earlier scans" in caplog.text
    assert json.loads((me / "fit.json").read_text())["complete"] is True


def test_a_new_start_leaves_no_poses_of_the_earlier_fit(tmp_path: Path, me: Path, quick: pytest.MonkeyPatch) -> None:
    fit.run(_config(tmp_path))

    def stop(*arguments: Any) -> None:
        raise KeyboardInterrupt

    with quick.context() as patch:
        patch.setattr(subject_fit, "write_fitted", stop)
        with pytest.raises(KeyboardInterrupt):
            fit.run(_config(tmp_path, seed=5, overwrite=True))
    assert _files(me) == {"skeleton.npz", "fit.json"}
    report = json.loads((me / "fit.json").read_text())
    assert (report["complete"], report["sequences"]) == (False, [])


def test_the_content_of_a_body_file_counts_and_not_its_path(
    tmp_path: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    motion = animal_motion("trot", 2)
    write_animal_meshes(tmp_path / "meshes" / "me", make_animal(0.06), [motion])
    for path in (tmp_path / "meshes" / "me").rglob("*.*"):
        if path.suffix != ".obj":
            path.unlink()
    rig = tmp_path / "animal.glb"
    rig.write_bytes(animal_glb(make_animal(0.06), [motion]))
    fit.run(_config(tmp_path, skeleton=str(rig)))
    rig = rig.rename(tmp_path / "moved.glb")
    fit.run(_config(tmp_path, skeleton=str(rig)))
    assert "1 of 1 sequence fitted already" in caplog.text
    rig.write_bytes(animal_glb(make_animal(0.08), [motion]))
    with pytest.raises(UserError, match=r"fitted with other settings \(.*body_digest \w+ -> \w+\)"):
        fit.run(_config(tmp_path, skeleton=str(rig)))


def test_a_second_fit_waits_or_is_told(tmp_path: Path, me: Path, quick: pytest.MonkeyPatch) -> None:
    with hold_output(me, "snarf fit"), pytest.raises(UserError, match=r"me is in use by snarf fit"):
        fit.run(_config(tmp_path))
    assert not _files(me)


def test_files_of_others_are_kept(tmp_path: Path, me: Path, quick: pytest.MonkeyPatch) -> None:
    (me / "skeleton.json").write_text("{}")
    (me / "walk" / "motion.bvh").write_text("HIERARCHY")
    with pytest.raises(UserError, match=r"skeleton\.json and 1 more file were not written by snarf fit; .*overwrite=true"):
        fit.run(_config(tmp_path))
    assert _files(me) == {"skeleton.json", "walk/motion.bvh"}
    (me / "skeleton.json").unlink()
    with pytest.raises(UserError, match=r"motion\.bvh was not written by snarf fit; move it, or .* to replace it$"):
        fit.run(_config(tmp_path))
    (me / "skeleton.json").write_text("{}")
    fit.run(_config(tmp_path, overwrite=True))
    assert _files(me) == {"skeleton.npz", "fit.json", "fit.png", "run/poses.npz", "walk/poses.npz"}


def test_all_leaves_out_subjects_with_poses_of_others(
    tmp_path: Path, me: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (me / "skeleton.json").write_text("{}")
    with pytest.raises(UserError, match=r"nothing to fit in .*meshes; wanted <subject>"):
        fit.run(_config(tmp_path, subject="all"))
    assert "left out: subject me, which has a skeleton or poses that snarf fit has not written" in caplog.text
    write_scans(tmp_path / "meshes" / "you" / "walk", 2, one_topology=True)
    fit.run(_config(tmp_path, subject="all"))
    assert _files(me) == {"skeleton.json"}
    assert "walk/poses.npz" in _files(tmp_path / "meshes" / "you")


def test_broken_scans_stop_the_fit_or_are_not_trusted(
    tmp_path: Path, me: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    damaged = me / "walk" / "1.ply"
    damaged.write_bytes(damaged.read_bytes()[:5000])
    for path in (me / "run").iterdir():
        path.write_bytes(b"ply")
    with pytest.raises(UserError, match=r"0\.ply .*; give skip_broken=true to leave such frames out"):
        fit.run(_config(tmp_path))
    assert not _files(me)
    assert fit.run(_config(tmp_path, skip_broken=True)) == 1
    assert "left out: sequence run, of which no frame can be read" in caplog.text
    arrays = np.load(me / "walk" / "poses.npz")
    assert len(arrays["poses"]) == 3
    assert arrays["trusted"].tolist() == [True, False, True]
    assert "1.ply" in arrays["reasons"][1]
    entry = json.loads((me / "fit.json").read_text())["sequences"][0]
    assert entry["residual_mm_per_frame"][1] is None
    assert entry["not_trusted_frames"][0]["frames"] == "1"


def test_scans_of_no_person_say_so(tmp_path: Path, quick: pytest.MonkeyPatch) -> None:
    place = tmp_path / "meshes" / "me" / "walk"
    place.mkdir(parents=True)
    trimesh.creation.box((1.2, 1.7, 0.6)).export(place / "0.ply")
    with pytest.raises(
        UserError, match=r"no person in the scans of me: in the best of 1 frame the body is \d+ mm from the points"
    ):
        fit.run(_config(tmp_path))
    assert not _files(place.parent)


def test_several_persons_and_different_persons(
    tmp_path: Path, quick: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "meshes" / "me"
    write_scans(place / "walk", 1)
    write_scans(place / "run", 1, betas=-3 * BETAS)
    fit.run(_config(tmp_path))
    assert "if these are different persons" in caplog.text
    (place / "both").mkdir()
    poses, places = toy_poses(1)
    one = trimesh.Trimesh(*toy_mesh(poses[0], places[0]), process=False)
    other = trimesh.Trimesh(*toy_mesh(poses[0], places[0] + np.array([1.9, 0, 0])), process=False)
    trimesh.util.concatenate([one, other]).export(place / "both" / "0.ply")
    with pytest.raises(UserError, match="the scans of me show several persons; keep one of them in each scan"):
        fit.run(_config(tmp_path, overwrite=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": DataConfig("builtin", 1, 1, 1)}, "data: wanted meshes, got builtin, which has poses already"),
        ({"subject": "you"}, "no subject 'you' in .*; wanted one of me"),
        ({"clothes": "thick"}, "clothes: wanted true, false or 0 to 0.06 metres, got 'thick'"),
        ({"clothes": "0.5"}, "clothes: wanted true, false or 0 to 0.06 metres"),
        ({"ordered": "yes"}, "ordered: wanted auto, true or false"),
        ({"points_per_frame": 100}, "points_per_frame: wanted 500 to 100000, got 100"),
        ({"frame_rate": 0.0}, "frame_rate: wanted"),
        ({"workers": -1}, "workers: wanted"),
        ({"scale": "inch"}, "data.scale: wanted auto or metres per unit"),
        ({"up": "x"}, "data.up: wanted auto, y or z, got 'x'"),
        ({"body": "a.npz", "skeleton": "b.glb"}, "body, skeleton: wanted at most one of them, got both"),
        ({"skeleton": "b.glb"}, "b.glb"),
        ({"body": "nobody.npz"}, "no body model at nobody.npz"),
        ({"gender": "none"}, "gender: wanted neutral, female or male"),
    ],
)
def test_bad_values_make_nothing(tmp_path: Path, me: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        fit.run(_config(tmp_path, **changes))
    assert not _files(me)
