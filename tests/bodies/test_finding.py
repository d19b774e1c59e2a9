"""Body models are found under the names of their releases, and never in place of another gender."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from snarfcli.bodies import find_body
from snarfcli.errors import UserError


def make(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    ("name", "kind", "gender"),
    [
        ("basicModel_f_lbs_10_207_0_v1.0.0.pkl", "smpl", "female"),
        ("basicmodel_m_lbs_10_207_0_v1.0.0.pkl", "smpl", "male"),
        ("basicModel_neutral_lbs_10_207_0_v1.0.0.pkl", "smpl", "neutral"),
        ("SMPL_python_v.1.1.0/smpl/models/basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl", "smpl", "neutral"),
        ("SMPL_python_v.1.1.0/smpl/models/basicmodel_f_lbs_10_207_0_v1.1.0.pkl", "smpl", "female"),
        ("models/smpl/SMPL_FEMALE.pkl", "smpl", "female"),
        ("smpl_neutral.npz", "smpl", "neutral"),
        ("models/smplh/SMPLH_MALE.pkl", "smplh", "male"),
        ("mano_v1_2/models/SMPLH_female.pkl", "smplh", "female"),
        ("smplh/neutral/model.npz", "smplh", "neutral"),
        ("body_models/smplx/SMPLX_NEUTRAL_2020.npz", "smplx", "neutral"),
        ("smplx_locked_head/smplx/male/model.npz", "smplx", "male"),
        ("smplx/SMPLX_MALE.pkl", "smplx", "male"),
    ],
)
def test_every_name(name, kind, gender, tmp_path):
    place = make(tmp_path, name, "dmpls/male/model.npz", "smpl/SMPL_to_SMPLX.pkl", "other/female/model.npz", "SMPL_MALE_uv.npz")
    assert find_body(place, kind, gender) == place / name
    assert find_body(place, None, gender.upper()) == place / name
    assert find_body(place / name, None, "f") == place / name  # a file is taken as it is
    for other in {"female", "male", "neutral"} - {gender}:
        with pytest.raises(UserError, match=rf"no {other} body model in .*got {name}; download it") as caught:
            find_body(place, None, other)
        assert "\n" not in str(caught.value)
    for other in {"smpl", "smplh", "smplx"} - {kind}:
        with pytest.raises(UserError, match=f"no {gender} SMPL.* model in"):
            find_body(place, other, gender)


def test_preferences(tmp_path):
    names = [  # best first
        "z/basicmodel_f_lbs_10_207_0_v1.1.0.npz",
        "z/basicmodel_f_lbs_10_207_0_v1.1.0.pkl",
        "z/basicmodel_f_lbs_10_207_0_v1.1.0_clean.npz",
        "basicModel_f_lbs_10_207_0_v1.0.0.pkl",
        "SMPL_FEMALE.npz",
        "a/SMPL_FEMALE.npz",
        "SMPL_FEMALE.pkl",
        "smplh/female/model.npz",
        "smplx/SMPLX_FEMALE.npz",
        "smplx/SMPLX_FEMALE.pkl",
        "smplx/SMPLX_FEMALE_2020.npz",
    ]
    make(tmp_path, *names)
    for name in names:
        found = find_body(tmp_path, None, "female")
        assert found == tmp_path / name
        found.unlink()


def test_the_message_says_what_was_looked_for(tmp_path):
    with pytest.raises(UserError, match=r"wanted basicmodel_m_lbs_10_207_0_v\*.pkl, SMPL_MALE.pkl, got no model"):
        find_body(tmp_path, "smpl", "male")
    with pytest.raises(UserError, match="no body model at"):
        find_body(tmp_path / "none", "smpl", "male")
    with pytest.raises(UserError, match="gender: wanted female, male, neutral, got 'x'"):
        find_body(tmp_path, "smpl", "x")
    with pytest.raises(UserError, match="kind: wanted smpl, smplh, smplx, got 'flame'"):
        find_body(tmp_path, "flame", "male")


def test_a_folder_that_is_the_model_folder_and_links(tmp_path):
    make(tmp_path / "real" / "smplh", "male/model.npz")
    assert find_body(tmp_path / "real" / "smplh", "smplh", "male").name == "model.npz"
    if not hasattr(os, "symlink"):
        pytest.skip("this system has no links")
    (tmp_path / "models").mkdir()
    try:
        (tmp_path / "models" / "smplh").symlink_to(tmp_path / "real" / "smplh", target_is_directory=True)
        (tmp_path / "models" / "again").symlink_to(tmp_path / "models", target_is_directory=True)
    except OSError:
        pytest.skip("links are not allowed here")
    assert find_body(tmp_path / "models", None, "male") == tmp_path / "models" / "smplh" / "male" / "model.npz"


def test_very_deep_and_very_full_folders(tmp_path, monkeypatch):
    make(tmp_path, "/".join("abcdefgh") + "/SMPL_MALE.pkl")
    with pytest.raises(UserError, match="no male"):
        find_body(tmp_path, None, "male")
    full = make(tmp_path / "full", *"12345", "SMPL_MALE.pkl")
    for bound in ("_MAX_ENTRIES", "_MAX_FOLDERS"):
        with monkeypatch.context() as patched:
            patched.setattr(f"snarfcli.bodies.finding.{bound}", 0)
            with pytest.raises(UserError, match="name the folder of the body models"):
                find_body(full, None, "male")


def test_bodies_beside_cape_are_found(tmp_path, monkeypatch):
    make(tmp_path, "smpl/SMPL_MALE.pkl", "cape_release/x")
    many = [SimpleNamespace(name=f"{n}.npz", is_file=lambda: True, is_dir=lambda: False) for n in range(150_000)]
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: many if Path(path).name == "cape_release" else scandir(path))
    assert find_body(tmp_path, "smpl", "male") == tmp_path / "smpl" / "SMPL_MALE.pkl"
