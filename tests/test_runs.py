"""Run folders and devices."""

from __future__ import annotations

from pathlib import Path

import pytest

from snarfcli.errors import UserError
from snarfcli.runs import choose_device, find_avatar, run_folder


def test_a_run_has_a_folder_of_its_own():
    assert run_folder("outputs", "builtin", "50002", "a.b-c") == Path("outputs/builtin/50002/a.b-c")
    for run in ("", ".", "..", "a/b", "/tmp", "..\\up", "C:x"):
        with pytest.raises(UserError, match="run: wanted the name of a folder"):
            run_folder("outputs", "builtin", "50002", run)
    with pytest.raises(UserError, match=r"subject: wanted the name of a folder, .* got '\.\.'"):
        run_folder("outputs", "builtin", "..", "mine")


def test_a_missing_avatar_names_runs_that_are_there(tmp_path):
    (tmp_path / "builtin" / "1" / "quick").mkdir(parents=True)
    (tmp_path / "builtin" / "1" / "quick" / "avatar.pt").touch()
    with pytest.raises(UserError, match="trained runs there: quick; did you mean 'quick'"):
        find_avatar(str(tmp_path), "builtin", "1", "quik", None)
    with pytest.raises(UserError, match=r'there: quick; give run=quick, run "snarf train subject=1 .*" or give ckpt'):
        find_avatar(str(tmp_path), "builtin", "1", "fast_snarf", None)
    (tmp_path / "builtin" / "1" / "slow").mkdir()
    (tmp_path / "builtin" / "1" / "slow" / "avatar.pt").touch()
    with pytest.raises(UserError, match="trained runs there: quick, slow; give run=NAME, run"):
        find_avatar(str(tmp_path), "builtin", "1", "fast_snarf", None)
    assert find_avatar(str(tmp_path), "x", "y", "z", str(tmp_path / "builtin" / "1" / "quick")).name == "avatar.pt"


def test_devices_are_named():
    assert choose_device("cpu").type == "cpu"
    for name in ("gpu", "meta", "cuda:99"):
        with pytest.raises(UserError, match="device"):
            choose_device(name)
