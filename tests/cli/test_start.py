"""What `snarf` without arguments prints."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from snarfcli.cli.command_list import COMMANDS
from snarfcli.cli.main import main
from snarfcli.cli.start import start_page


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put(path: str, age_s: float = 0) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("")
    os.utime(file, (1e9 - age_s, 1e9 - age_s))
    return file


def printed(capsys) -> list[str]:
    assert main([]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out.splitlines()


def test_a_new_folder_starts_with_preprocess(capsys):
    lines = printed(capsys)
    assert len(lines) == 5
    assert lines[1].startswith("First: snarf preprocess subject=50002, then train")
    assert lines[2:] == [
        "Samples in data/processed: none yet",
        "Avatars in outputs: none yet",
        "Next: snarf preprocess subject=50002",
    ]


def test_samples_are_trained_next(capsys):
    put("data/processed/builtin/50004/manifest.json", 5)
    put("data/processed/meshes/fox/manifest.json")
    (Path("data/processed/builtin/50009")).mkdir()  # interrupted: without a manifest
    lines = printed(capsys)
    assert lines[2] == "Samples in data/processed: meshes/fox, builtin/50004"
    assert lines[4] == "Next: snarf train data=meshes subject=fox training=quick"


def test_avatars_are_animated_next(capsys):
    for number in range(5):
        put(f"outputs/builtin/50002/s{number}/avatar.pt", number)
    put("outputs/builtin/50002/fast_snarf/avatar.pt", 9)
    lines = printed(capsys)
    assert lines[3] == "Avatars in outputs: builtin/50002/s0, builtin/50002/s1, builtin/50002/s2 and 3 more"
    assert lines[4] == "Next: snarf animate subject=50002 run=s0"
    put("outputs/builtin/50002/fast_snarf/avatar.pt", -9)
    assert printed(capsys)[4] == "Next: snarf animate subject=50002"


def test_the_command_that_comes_next_is_one(capsys):
    put("outputs/builtin/50002/demo/avatar.pt")
    for line in (printed(capsys)[4], start_page(Path("none"), Path("none")).splitlines()[4]):
        words = shlex.split(line.removeprefix("Next: "))
        assert words[0] == "snarf"
        assert words[1] in COMMANDS
        assert all(re.fullmatch(r"\w+=\w+", word) for word in words[2:])


def test_names_of_folders_do_nothing_to_the_terminal_or_the_shell(capsys):
    put("outputs/meshes/a\x1b[2J\nb; rm -rf x/run/avatar.pt")
    lines = printed(capsys)
    assert len(lines) == 5
    assert "\x1b" not in "".join(lines)
    assert shlex.split(lines[4])[1:] == ["snarf", "animate", "data=meshes", "subject=a [2J b; rm -rf x", "run=run"]


def test_nothing_heavy_is_imported():
    """The page appears at once."""
    code = "import sys; from snarfcli.cli.main import main; main([]); print({'torch', 'hydra', 'numpy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "set()"
