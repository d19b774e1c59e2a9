"""DFaust and PosePrior from generated AMASS files in every released layout: the same samples from each."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from licensed_files import BETAS, amass_poses, write_body, write_dfaust, write_new, write_old

from snarfcli.cli.main import main
from snarfcli.datasets.amass_files import papers_split
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError
from snarfcli.motions import read_motion


def load(root: Path, data: str = "dfaust", subject: str = "50002", **config: object) -> SubjectData:
    """Load one subject as the command does."""
    return find_dataset(data).load(subject, Request(DataConfig(data, 1, 1, 10, **config), root))


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder as the older archives unpack, with a body."""
    root = tmp_path_factory.mktemp("old")
    write_dfaust(root)
    write_body(root / "smpl")
    return root


def assert_same(one: SubjectData, other: SubjectData, tolerance: float) -> None:
    """Compare everything that samples are made from."""
    assert [(s.name, s.split) for s in one.sequences] == [(s.name, s.split) for s in other.sequences]
    np.testing.assert_array_equal(one.skeleton.joints_rest, other.skeleton.joints_rest)
    np.testing.assert_array_equal(one.template.vertices, other.template.vertices)
    for mine, theirs in zip(one.sequences, other.sequences, strict=True):
        np.testing.assert_allclose(mine.motion.poses, theirs.motion.poses, atol=tolerance)
        np.testing.assert_array_equal(mine.motion.translation, theirs.motion.translation)
        assert mine.motion.frame_rate == theirs.motion.frame_rate == 60.0


def test_the_papers_split(old: Path) -> None:
    subject = load(old)
    assert [s.name for s in subject.of_split("test")] == ["chicken_wings"]
    assert [s.name for s in subject.of_split("ood")] == ["op2", "op3", "op4", "op5", "op7", "op8", "op9"]
    assert len(subject.of_split("train")) == 9
    assert not subject.broken
    np.testing.assert_array_equal(subject.betas, BETAS[:10])
    for spec in subject.sequences:
        assert not spec.motion.translation.any()
    hips = next(s for s in subject.sequences if s.name == "hips")
    # z is up in AMASS; without the root the poses are those of the file, hands straight
    np.testing.assert_allclose(hips.motion.poses.reshape(-1, 72)[:, 3:], amass_poses("hips")[:, 3:])
    vertices, faces = hips.meshes[2]
    assert vertices.shape == (6890, 3)
    assert faces.shape == (13776, 3)
    assert any("basicModel_f_lbs_10_207_0_v1.0.0.npz (female)" in line for line in subject.sources)
    split = papers_split()["dfaust"]
    assert len(split) == 10
    assert all(len(parts["train"]) == 9 and not set(parts["train"]) & set(parts["test"]) for parts in split.values())


@pytest.mark.parametrize(
    ("release", "nested", "dtype", "tolerance"),
    [
        ("old", "amass/DFaust67", np.float64, 0.0),
        ("old", "", np.float32, 1e-6),  # float32 angles of up to 3
        ("new", "AMASS/SMPL-X", np.float64, 0.0),
    ],
)
def test_every_layout_gives_the_same_subject(
    old: Path, tmp_path: Path, release: str, nested: str, dtype: type, tolerance: float
) -> None:
    write_dfaust(tmp_path, release=release, nested=nested, dtype=dtype)
    write_body(tmp_path / "body_models" / "smpl" / "models")
    assert_same(load(tmp_path), load(old), tolerance)


def test_odd_files_are_read_alike(tmp_path: Path) -> None:
    poses = amass_poses("hips")
    write_old(tmp_path / "a.npz", poses)
    write_old(tmp_path / "b.npz", poses, mocap_framerate=None, gender=np.array(b"female"), betas=BETAS[:10])
    write_old(tmp_path / "c.npz", poses, dmpls=None, gender=None)
    write_new(tmp_path / "d.npz", poses, poses=None)
    first, *others = (read_motion(tmp_path / f"{name}.npz") for name in "abcd")
    for other in others:
        np.testing.assert_allclose(other.poses, first.poses, atol=1e-12)
        np.testing.assert_allclose(other.translation, first.translation, atol=1e-12)
        assert other.frame_rate == first.frame_rate == 60.0


def test_files_of_other_archives_are_not_taken(old: Path, tmp_path: Path) -> None:
    write_dfaust(tmp_path, nested="archives/DFaust67")
    write_body(tmp_path)
    for folder in ("MPI_mosh", "renamed", "MPImosh/MPI_mosh"):  # subjects and exercises of MoSh have the same names
        write_old(tmp_path / folder / "50002" / "jumping_jacks_poses.npz", amass_poses("knees"))
    write_old(tmp_path / "MPI_mosh" / "50009" / "jumping_jacks_poses.npz", amass_poses("knees"))
    assert_same(load(tmp_path), load(old), 0.0)
    assert find_dataset("dfaust").subjects(Request(DataConfig("dfaust", 1, 1, 10), tmp_path)) == ("50002",)
    (tmp_path / "archives/DFaust67/DFaust_67/50002/50002_jumping_jacks_poses.npz").unlink()
    assert [name for name, _ in load(tmp_path).broken] == ["jumping_jacks"]


def test_a_broken_recording_does_not_hide_the_person(tmp_path: Path) -> None:
    write_dfaust(tmp_path, release="new")
    write_body(tmp_path)
    first = tmp_path / "DFaust" / "50002" / "50002_chicken_wings_stageii.npz"
    first.write_bytes(first.read_bytes()[:500])
    subject = load(tmp_path)
    assert [name for name, _ in subject.broken] == ["chicken_wings"]
    assert "made for SMPL-X" in subject.sources[1]
    np.testing.assert_array_equal(subject.betas, BETAS[:10])
    for path in first.parent.iterdir():
        path.write_bytes(b"")
    with pytest.raises(UserError, match=r"50002_chicken_wings_stageii.npz"):
        load(tmp_path)


def test_poseprior_alone(old: Path) -> None:
    prior, dfaust = load(old, "poseprior"), load(old)
    assert prior.data == "poseprior"
    assert {s.split for s in prior.sequences} == {"ood"}
    np.testing.assert_array_equal(prior.betas, dfaust.betas)
    for mine, theirs in zip(prior.sequences, dfaust.of_split("ood"), strict=True):
        np.testing.assert_array_equal(mine.motion.poses, theirs.motion.poses)
    assert find_dataset("poseprior").subjects(Request(DataConfig("poseprior", 1, 1, 10), old)) == ("50002",)


@pytest.mark.parametrize("data", ["dfaust", "poseprior"])
def test_hands_are_one_of_two_choices(old: Path, data: str) -> None:
    released, rest = load(old, data, hands="released"), load(old, data)
    assert all(np.allclose(spec.motion.poses[:, 22:], 0.3) for spec in released.sequences)
    assert not any(spec.motion.poses[:, 22:].any() for spec in rest.sequences)
    with pytest.raises(UserError, match=r"data.hands: wanted rest or released, got 'fist'"):
        load(old, data, hands="fist")


def test_what_is_missing_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(UserError, match=r"no DFaust sequences of subject 50002 below .*DFaust_67/50002/50002_hips_poses.npz"):
        load(tmp_path)
    with pytest.raises(UserError, match="no DFaust subject '50003'; did you mean '500"):
        load(tmp_path, subject="50003")
    write_dfaust(tmp_path)
    with pytest.raises(UserError, match="female"):
        load(tmp_path)  # no body model
    write_body(tmp_path, "male")
    with pytest.raises(UserError, match="female"):
        load(tmp_path)  # none of this gender; never silently another
    write_body(tmp_path)
    (tmp_path / "DFaust_67" / "50002" / "50002_hips_poses.npz").unlink()
    knees = tmp_path / "DFaust_67" / "50002" / "50002_knees_poses.npz"
    knees.write_bytes(knees.read_bytes()[:500])
    for path in (tmp_path / "MPI_Limits" / "03099").iterdir():
        path.unlink()
    with caplog.at_level(logging.WARNING):
        subject = load(tmp_path)
    assert "no PosePrior (MPI_Limits) below" in caplog.text
    reasons = dict(subject.broken)
    assert sorted(reasons) == ["hips", "knees"]
    assert "has no file below" in reasons["hips"]
    assert "50002_knees_poses.npz" in reasons["knees"]
    with pytest.raises(UserError, match=r"no PosePrior sequences below .*MPI_Limits/03099/op2_poses.npz"):
        load(tmp_path, "poseprior")


def test_from_files_to_tables(
    old: Path, tmp_path: Path, capsys: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    folders = [f"data_root={tmp_path}", f"data.folder={old}"]
    made = ["points_per_frame=160", "workers=2", f"body={old}", *folders]
    assert main(["preprocess", "data=dfaust", "sequences=[hips,chicken_wings,op2]", *made]) == 0
    assert "from body" in caplog.text
    assert "4 train, 4 test, 2 ood frames" in caplog.text
    assert main(["preprocess", "data=poseprior", "sequences=[op3]", *made]) == 0
    outputs = [f"output_root={tmp_path / 'out'}", f"data_root={tmp_path}"]
    small = ["training.steps=4", "training.poses_per_step=1", "training.uniform_points=40", "training.surface_points=40"]
    assert main(["train", "data=dfaust", "training=smoke", *small, *outputs]) == 0
    part = ["max_frames=1", "figure=false"]
    assert main(["eval", "data=dfaust", *part, *outputs]) == 0
    assert main(["eval", "data=dfaust", "--ood", *part, *outputs]) == 0
    assert main(["eval", "data=poseprior", "--ood", *part, *outputs]) == 0
    assert main(["eval", "data=poseprior", *part, *outputs]) == 2
    errors = capsys.readouterr().err
    assert "no sequence of split test, only of ood; evaluate out of distribution (--ood)" in errors
    results = sorted(path.parent.name for path in (tmp_path / "out" / "dfaust" / "50002" / "fast_snarf").glob("*/metrics.json"))
    assert results == ["eval_id_part", "eval_ood_part", "eval_ood_poseprior_part"]
