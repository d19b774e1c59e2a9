"""Processes that are started in a folder with modules of the names of others import none of them."""

from __future__ import annotations

import multiprocessing.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fake_runs import fake_plan, fake_run
from toy_subject import toy_subject

from snarfcli import safe_start
from snarfcli.commands import preprocess
from snarfcli.commands.preprocess import PreprocessConfig
from snarfcli.datasets.settings import DataConfig
from snarfcli.hydra_config.launchers import is_installed
from snarfcli.parallel import run_in_processes
from snarfcli.reproduce.launchers import Launcher
from snarfcli.reproduce.launching import launch
from snarfcli.reproduce.running import run_command
from snarfcli.safe_start import safe_environment, safe_imports, snarf_command

NAMES = ("signal", "struct", "pickle", "json", "random", "multiprocessing", "socket", "torch", "numpy", "hydra", "snarfcli")


@pytest.fixture
def imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder of hostile modules the current folder, and return the file where those that are imported sign."""
    signed, folder = tmp_path / "imported", tmp_path / "hostile"
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({str(signed)!r}, 'a').write(__name__ + ' ')\nraise ImportError('hostile')\n")
    monkeypatch.chdir(folder)
    return signed


def test_the_folder_is_hostile(imported: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    assert subprocess.run([sys.executable, "-c", "import struct"], capture_output=True, env=environment).returncode == 1
    assert imported.read_text() == "struct "


@pytest.mark.parametrize("knows_variable", [True, False] if sys.version_info >= (3, 11) else [False])
def test_workers(knows_variable: bool, imported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr(safe_start, "_KNOWS_VARIABLE", knows_variable)
    util: Any = multiprocessing.util
    original = util._args_from_interpreter_flags
    assert [item for _, item in run_in_processes(range, [(3,)], 1)] == [0, 1, 2]
    assert not imported.exists()
    assert "PYTHONSAFEPATH" not in os.environ
    assert util._args_from_interpreter_flags is original


@pytest.mark.parametrize("knows_variable", [True, False] if sys.version_info >= (3, 11) else [False])
def test_the_process_that_watches_over_the_workers(knows_variable: bool, imported: Path, tmp_path: Path) -> None:
    """It is started once in a process, before the first worker, so the test needs a process of its own."""
    script = tmp_path / "script.py"
    script.write_text(
        "from snarfcli import safe_start\nfrom snarfcli.parallel import run_in_processes\n"
        f"safe_start._KNOWS_VARIABLE = {knows_variable}\n"
        "if __name__ == '__main__':\n    print([item for _, item in run_in_processes(range, [(3,)], 1)])\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    package = str(Path(safe_start.__file__).parents[1])
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [package, environment.get("PYTHONPATH")]))
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment)
    assert (done.stdout.strip(), done.stderr) == ("[0, 1, 2]", "")
    assert not imported.exists()


def test_preprocess(imported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("snarfcli.datasets.builtin.load", lambda name, request: toy_subject(train_frames=2))
    preprocess.run(PreprocessConfig(
        subject="toy", data=DataConfig("builtin", 1, 1, 1), data_root=str(tmp_path), points_per_frame=80, padding=0.1,
        surface_noise_m=0.01, inside_test="winding", poisson="auto", workers=2, seed=0, overwrite=False, sequences=["fold"],
        skip_broken=False, body=None,
    ))  # fmt: skip
    assert not imported.exists()


@pytest.mark.parametrize("name", ["local", "joblib"])
def test_jobs_of_reproduce(name: str, imported: Path, tmp_path: Path) -> None:
    if name == "joblib" and (sys.version_info < (3, 11) or not is_installed(name)):
        pytest.skip("hydra-joblib-launcher is not installed, or Python lacks PYTHONSAFEPATH")
    jobs = fake_plan(tmp_path, systems=("snarf", "nasa")).jobs
    for job in jobs:  # all results exist, so that only the processes are tested
        fake_run(job, {"id": 0.9, "ood": 0.8})
    statuses = launch(jobs, tmp_path / "work", Launcher(name, 2), lambda *_: None)
    assert [status and status.state for status in statuses] == ["done", "done"]
    assert not imported.exists()


def test_commands_of_a_job(imported: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert run_command(["train", "subject=none", f"data_root={tmp_path}"], log, lambda: False) == 2
    assert "no built-in subject 'none'" in log.read_text()
    assert not imported.exists()


def test_a_command_starts_safely_by_its_arguments_alone_and_keeps_the_users_path(imported: Path, tmp_path: Path) -> None:
    """As Python 3.10 does, which ignores the variable."""
    environment = {name: value for name, value in safe_environment().items() if name != "PYTHONSAFEPATH"}
    done = subprocess.run(snarf_command(["--version"]), capture_output=True, text=True, env=environment)
    assert done.stdout.startswith("snarf ")
    assert not imported.exists()
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "sitecustomize.py").write_text("print('mine')")
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(tmp_path / "own"), environment.get("PYTHONPATH")]))
    done = subprocess.run(snarf_command(["--version"]), capture_output=True, text=True, env=environment)
    assert done.stdout.splitlines()[0] == "mine"


def test_the_environment_is_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONSAFEPATH", "yes")
    with safe_imports():
        pass
    assert os.environ["PYTHONSAFEPATH"] == "yes"
    assert safe_environment()["PYTHONSAFEPATH"] == "1"
