"""The short forms of `tools/trust_faults.py` and `tools/trust_pairs.py`: crashes, failing disks, and two commands at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from trust.faults import build_shim

TOOLS = Path(__file__).parents[2] / "tools"
_COMMANDS = ("preprocess", "train", "eval", "animate", "export_vrm", "export_meshes")


@pytest.fixture(scope="module", autouse=True)
def _needs_faults(tmp_path_factory: pytest.TempPathFactory) -> None:
    if build_shim(tmp_path_factory.mktemp("shim")) is None:
        pytest.skip("needs Linux and a C compiler")


def run_tool(name: str, *arguments: str) -> str:
    """Run a tool and return what it printed; it prints each thing that was wrong."""
    done = subprocess.run([sys.executable, TOOLS / name, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("command", _COMMANDS)
def test_a_second_run_completes_what_a_crash_or_a_failing_disk_has_left(command: str) -> None:
    said = run_tool("trust_faults.py", "--only", command, "--points", "2")
    assert [line.split(":")[0].strip() for line in said.splitlines()] == [command, "kill", "full", "io"]
    assert said.count(", 0 wrong,") == 3


@pytest.mark.parametrize("command", ["preprocess", "train", "export_vrm"])
def test_two_at_once_give_the_files_of_one(command: str) -> None:
    assert ": 2 pairs, 0 wrong," in run_tool("trust_pairs.py", "--only", command, "--pairs", "2")
