"""The Makefile: what its targets would run. Nothing is installed or built."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(shutil.which("make") is None or os.name == "nt", reason="wants make")


def commands(target: str, environment: Path) -> list[str]:
    """Return the commands of a target with a virtual environment, made or not."""
    options = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    call = ["make", "--dry-run", f"VIRTUAL_ENV={environment}", "PYTHON=python3", target]
    done = subprocess.run(call, cwd=ROOT, env=options, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_demo_takes_the_commands_that_are_installed(tmp_path):
    first, second, *_ = commands("demo", tmp_path / "none")
    assert first == f"PYTHON=python3 tools/set_up.sh {tmp_path / 'none'} commands"
    assert second == f"{tmp_path / 'none'}/bin/snarf preprocess subject=50002"
    (tmp_path / "there/bin").mkdir(parents=True)
    (tmp_path / "there/bin/snarf").touch()
    assert commands("demo", tmp_path / "there")[0] == f"{tmp_path / 'there'}/bin/snarf preprocess subject=50002"


def test_the_tests_need_more_than_the_commands(tmp_path):
    (tmp_path / "there/bin").mkdir(parents=True)
    (tmp_path / "there/bin/snarf").touch()
    assert commands("test", tmp_path / "there")[0] == f"PYTHON=python3 tools/set_up.sh {tmp_path / 'there'}"


def test_every_target_is_in_the_help():
    text = (ROOT / "Makefile").read_text("utf-8")
    (phony,) = [line.removeprefix(".PHONY:").split() for line in text.splitlines() if line.startswith(".PHONY:")]
    told = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert [name for name in phony if f"make {name} " not in told] == ["help"]
