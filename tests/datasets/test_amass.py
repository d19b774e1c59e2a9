"""Motions in AMASS's format from any folder: subjects, shapes, splits, messages, and the way to the tables."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from licensed_files import BETAS, amass_poses, write_body, write_new, write_old

from snarfcli.bodies import builtin_body
from snarfcli.cli.main import main
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError


def request(folder: Path | None, root: Path, body: Path | None = None, **config: object) -> Request:
    folder_name = None if folder is None else str(folder)
    return Request(DataConfig("amass", 1, 1, 1, folder=folder_name, **config), root, None if body is None else str(body))


def load(folder: Path, subject: str | None = None, **settings: object) -> SubjectData:
    """Load one subject as the command does, by default the one named as the folder, without an SMPL body."""
    return find_dataset("amass").load(subject or folder.name, request(folder, folder / "no_data", **settings))


def subjects(folder: Path | None, root: Path) -> tuple[str, ...]:
    return find_dataset("amass").subjects(request(folder, root))


def splits(data: SubjectData) -> dict[str, tuple[str, int]]:
    """Return split and number of frames by name of the sequence."""
    return {spec.name: (spec.split, spec.motion.num_frames) for spec in data.sequences}


def write_clips(folder: Path, *names: str, frames: int = 10, **changes: object) -> Path:
    for name in names:
        write_old(folder / f"{name}_poses.npz", amass_poses(name, frames), **changes)
    return folder


@pytest.fixture
def few(tmp_path: Path) -> Path:
    return write_clips(tmp_path / "clips", "walk", "jog", "ood_flip", "ood/kick")


def test_of_few_sequences_the_ends_are_held_back(few: Path) -> None:
    data = load(few)
    assert splits(data) == {
        "jog": ("train", 8),
        "walk": ("train", 8),
        "jog_end": ("test", 2),
        "walk_end": ("test", 2),
        "ood_flip": ("ood", 10),
        "ood_kick": ("ood", 10),
    }
    jog, end = (next(spec for spec in data.sequences if spec.name == name) for name in ("jog", "jog_end"))
    poses = np.concatenate([jog.motion.poses, end.motion.poses]).reshape(10, 72)
    np.testing.assert_allclose(poses[:, 3:], amass_poses("jog", 10)[:, 3:])  # the root is turned to y up
    assert (jog.motion.frame_rate, end.motion.name) == (60.0, "jog_end")
    np.testing.assert_array_equal(end.meshes[1][0].shape, (6890, 3))
    assert not any(spec.motion.translation.any() for spec in data.sequences)
    assert any("fewer than 5 sequences in distribution" in line for line in data.sources)


def test_of_five_sequences_the_last_is_held_out(tmp_path: Path) -> None:
    folder = write_clips(tmp_path / "clips", *"abcde", "ood_f")
    data = load(folder)
    assert {name: split for name, (split, _) in splits(data).items()} == {
        **dict.fromkeys("abcd", "train"), "e": "test", "ood_f": "ood",
    }  # fmt: skip
    assert not any("fewer than" in line for line in data.sources)


def test_sequences_are_held_out_by_name(few: Path) -> None:
    data = load(few, test=["jog"], ood=["ood_f*"])
    assert splits(data) == {"ood_kick": ("train", 10), "walk": ("train", 10), "jog": ("test", 10), "ood_flip": ("ood", 10)}
    with pytest.raises(UserError, match=r"data.test: no sequence 'jig'; did you mean 'jog'\?"):
        load(few, test=["jig"])


def test_names_of_ends_are_unique_and_single_frames_whole(tmp_path: Path) -> None:
    folder = write_clips(tmp_path / "clips", "walk", "walk_end")
    write_clips(folder, "pose", frames=1)
    assert splits(load(folder)) == {
        "pose": ("train", 1),
        "walk": ("train", 8),
        "walk_end": ("train", 8),
        "walk_end_2": ("test", 2),
        "walk_end_end": ("test", 2),
    }


def test_a_folder_of_subjects(tmp_path: Path) -> None:
    root = tmp_path / "data"
    write_clips(root / "amass" / "01", "01_01", "session/01_02", "MPI_mosh/a")
    write_clips(root / "amass" / "02", "02_01")
    np.savez(root / "amass" / "02" / "female_stagei.npz", betas=BETAS)
    np.savez(root / "amass" / "shape.npz", betas=BETAS)  # is no motion, so the folder is not one subject
    (root / "amass" / "empty").mkdir()
    (root / "amass" / "02" / "._hidden.npz").touch()
    assert subjects(None, root) == ("01", "02")
    assert subjects(root / "amass" / "01", root) == ("01",)
    assert subjects(root / "amass" / "01" / "session" / "..", root) == ("01",)
    first, second = (find_dataset("amass").load(subject, request(None, root)) for subject in ("01", "02"))
    assert {"01_01", "session_01_02", "MPI_mosh_a"} <= set(splits(first))
    assert set(splits(second)) == {"02_01", "02_01_end"}
    with pytest.raises(UserError, match=r"no subject '03' in .*amass; did you mean"):
        find_dataset("amass").load("03", request(None, root))


def test_every_layout_gives_the_same_poses(tmp_path: Path) -> None:
    poses = amass_poses("jog", 10)
    folder = tmp_path / "clips"
    write_old(folder / "a_poses.npz", poses)
    write_new(folder / "b_stageii.npz", poses)
    folder.joinpath("c.npz").write_bytes(b"")
    np.savez(folder / "c.npz", poses=poses, trans=np.ones((10, 3)), betas=BETAS[:10], gender="female", mocap_framerate=60.0)
    np.savez(folder / "d.npz", poses=poses)
    data = load(folder, test=["d"], up="z")
    motions = [spec.motion for spec in data.sequences]
    assert [motion.name for motion in motions] == ["a", "b", "c", "d"]
    for motion in motions[1:]:
        np.testing.assert_allclose(motion.poses, motions[0].poses, atol=1e-12)
        assert motion.frame_rate == 60.0
    assert load(folder, hands="released", test=["d"]).sequences[0].motion.poses[:, 22:].any()


def test_the_shape_is_that_of_the_files(few: Path) -> None:
    data = load(few)
    body = builtin_body()
    np.testing.assert_array_equal(data.betas, BETAS[:10])
    np.testing.assert_allclose(data.skeleton.joints_rest, body.shaped(BETAS[:10])[1])
    assert "the built-in body (CC0); no female SMPL model below" in data.sources[0]
    assert "jog_poses.npz (parameters made for SMPL give another shape with the built-in body)" in data.sources[1]
    write_clips(few, "run", betas=-BETAS)
    write_clips(few, "skip", betas=None)
    data = load(few)
    np.testing.assert_array_equal(data.betas, BETAS[:10])
    assert data.sources[1].endswith("; 1 of 6 sequences have another shape or gender, which is not used")
    np.savez(few / "shape.npz", betas=np.ones(10), gender="neutral")
    np.testing.assert_array_equal(load(few).betas, np.ones(10))


def test_without_a_shape_it_is_the_average(tmp_path: Path) -> None:
    folder = write_clips(tmp_path / "clips", "walk", betas=None, gender=None)
    data = load(folder)
    assert data.sources[0].startswith("the built-in body (CC0); no neutral SMPL model below")
    assert data.sources[1] == "the average shape of the body"
    np.testing.assert_allclose(data.skeleton.joints_rest, builtin_body().shaped(None)[1])


def test_the_body_of_the_recorded_gender_is_found(few: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    male = write_body(root / "smpl", "male")
    assert "built-in" in find_dataset("amass").load("clips", request(few, root)).sources[0]
    with pytest.raises(UserError, match="no female SMPL model in"):
        find_dataset("amass").load("clips", request(few, root, male.parent))
    female = write_body(root / "smpl")
    assert find_dataset("amass").load("clips", request(few, root)).sources[0] == f"body {female} (female)"
    assert find_dataset("amass").load("clips", request(few, root, male)).sources[0].startswith(f"body {male}")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"trans": np.zeros((2, 3))}, r"broken.npz: wanted 'poses', got trans"),
        ({"poses": np.zeros((2, 70))}, r"broken.npz: wanted 72 \(SMPL\), 156 \(SMPL-H\) or 165 \(SMPL-X\) values"),
        ({"poses": np.zeros((0, 156))}, r"broken.npz: wanted at least 1 frame"),
        ({"poses": np.zeros((2, 156)), "trans": np.zeros((3, 3))}, r"broken.npz: trans: wanted shape \[2, 3\]"),
        ({"poses": np.zeros((2, 156)), "betas": np.full(10, np.nan)}, r"broken.npz: betas: wanted at least 1 finite"),
        ({"poses": np.array([{}])}, r"broken.npz"),
    ],
)
def test_a_broken_file_is_named_and_alone(few: Path, content: dict, message: str) -> None:
    np.savez(few / "broken.npz", **content)
    data = load(few)
    [(name, reason)] = data.broken
    assert name == "broken"
    assert reason.isprintable()
    with pytest.raises(UserError, match=message):
        raise UserError(reason)
    assert len(splits(data)) == 6
    for path in few.rglob("*_poses.npz"):
        path.unlink()
    with pytest.raises(UserError, match=message):
        load(few)


def test_a_broken_file_does_not_change_the_split(tmp_path: Path) -> None:
    folder = write_clips(tmp_path / "clips", *"abcde")
    (folder / "e_poses.npz").write_bytes(b"")
    data = load(folder)
    assert {split for split, _ in splits(data).values()} == {"train"}
    assert [name for name, _ in data.broken] == ["e"]


def test_what_is_missing_is_named(few: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"the folder of motions .*data.amass does not exist; give data.folder=FOLDER with"):
        subjects(None, tmp_path / "data")
    with pytest.raises(UserError, match=r"jog_poses.npz is not a folder"):
        subjects(few / "jog_poses.npz", tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"no motion files in .*empty: wanted motion files such as walk_poses.npz"):
        subjects(tmp_path / "empty", tmp_path)
    with pytest.raises(UserError, match=r"no subject '50002' in .*clips; wanted one of clips"):
        load(few, "50002")
    with pytest.raises(UserError, match=r"data.up: wanted auto, y, z, x, -y, -z or -x, got 'w'"):
        load(few, up="w")
    with pytest.raises(UserError, match=r"data.hands: wanted rest or released, got 'fist'"):
        load(few, hands="fist")
    for name in ("jog", "walk"):
        (few / f"{name}_poses.npz").unlink()
    with pytest.raises(
        UserError, match=r"no sequence is left to train on: ood_flip, ood_kick are all held out \(without data.ood"
    ):
        load(few)


def test_from_files_to_tables(few: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    folders = [f"data_root={tmp_path / 'data'}", f"output_root={tmp_path / 'out'}"]
    one = ["data=amass", "subject=clips"]
    assert main(["doctor", "data=amass", f"data.folder={few}", *folders]) == 0
    settings = f"data=amass subject=clips data.folder={few} data_root={tmp_path / 'data'}"
    assert f'usable; next: "snarf preprocess {settings}"' in caplog.text
    sampled = ["points_per_frame=160", "workers=2", "data.frame_step=4", "data.ood_frame_step=8", folders[0]]
    assert main(["preprocess", *one, f"data.folder={few}", *sampled]) == 0
    assert "4 train, 4 test, 4 ood frames" in caplog.text
    small = ["training.steps=4", "training.poses_per_step=1", "training.uniform_points=40", "training.surface_points=40"]
    assert main(["train", *one, "training=smoke", *small, *folders]) == 0
    part = ["max_frames=1", "figure=false"]
    assert main(["eval", *one, *part, *folders]) == 0
    assert main(["eval", "--ood", *one, *part, *folders]) == 0
    results = sorted(path.parent.name for path in (tmp_path / "out" / "amass" / "clips" / "fast_snarf").glob("*/metrics.json"))
    assert results == ["eval_id_part", "eval_ood_part"]
