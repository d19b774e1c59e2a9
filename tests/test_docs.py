"""The README and the pages of the documentation: programs run, commands and links are right, and what is named exists."""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from documents import python_examples, run_examples
from small_human import small_human

import snarfcli.motions
from snarfcli.avatar import Avatar
from snarfcli.cli.command_list import COMMANDS
from snarfcli.cli.flags import translate_flags
from snarfcli.errors import UserError
from snarfcli.hydra_config.overrides import check_overrides
from snarfcli.motions import Motion, builtin_motion

ROOT = Path(__file__).parents[1]
README, PYTHON = ROOT / "README.md", ROOT / "docs/python.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "data/README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUN_ELSEWHERE = {"library.md", "from_fast_snarf.md"}  # by test_library_docs.py


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return small_human()


@pytest.fixture
def demo(avatar, tmp_path, monkeypatch) -> Path:
    """A folder with the avatar of `make demo` and a motion file, as the examples expect them."""
    monkeypatch.setattr(Avatar, "load", lambda path, device="cpu": avatar)  # the surfaces of one avatar are computed once
    np.savez(
        tmp_path / "walk.npz", poses=0.1 * np.sin(np.arange(216).reshape(3, 72)), trans=np.zeros((3, 3)), mocap_framerate=30
    )
    monkeypatch.setattr(snarfcli.motions, "builtin_motion", short_motion)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def short_motion(name: str, seed: int, *, frame_rate: float = 60.0) -> Motion:
    """Return the first frames of a built-in motion."""
    return builtin_motion(name, seed, frame_rate=frame_rate).slice(stop=8)


def test_the_programs_of_the_readme_run(demo):
    names = run_examples(README, python_examples(README))
    assert names["inside"].shape == (1, 1000)
    assert names["posed_values"].shape == (1, 1000)
    assert 10 < int((names["posed_values"] > -0.1).sum()) < 500
    assert {path.name for path in demo.iterdir()} == {"walk.npz", "me.glb", "my_avatar"}


def test_the_programs_of_the_page_on_python_run(demo):
    torch.manual_seed(0)
    names = run_examples(PYTHON, python_examples(PYTHON))
    assert {"me.glb", "me.html", "me.bvh", "me.vrm", "me.vrma", "my_avatar"} <= {path.name for path in demo.iterdir()}
    assert names["posed_values"].shape == (1, 1000)
    inside = names["posed_values"] > -0.1
    assert 10 < int(inside.sum()) < 500
    assert names["deformer"].num_bones == 24


def test_no_other_page_has_programs_that_nobody_runs():
    with_programs = {page.name for page in PAGES if python_examples(page)}
    assert with_programs == {README.name, PYTHON.name} | RUN_ELSEWHERE


def test_the_readme_is_short():
    text = README.read_text("utf-8")
    assert len(text.split()) <= 1000
    assert text.count("![") == 1


def commands_of(page: Path) -> list[str]:
    """Return the lines of code, indented or in a table, that call snarf, without comments and pipes."""
    text = page.read_text("utf-8")
    lines = re.findall(r"^ {4}.*?(snarf [a-z]+ .*)$", text, re.MULTILINE) + re.findall(r"`(snarf [a-z]+ [^`]*=[^`]*)`", text)
    return [re.split(r"\s+#|\s{3,}", line)[0].strip() for line in lines]


@cache
def schema_of(command: str) -> type:
    import importlib

    return getattr(importlib.import_module(f"snarfcli.commands.{COMMANDS[command].module}"), COMMANDS[command].schema)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if commands_of(page)], ids=lambda page: f"{page.parent.name}/{page.stem}"
)
def test_the_commands_of_a_page_have_settings_that_exist(page):
    wrong = []
    for line in commands_of(page):
        _, name, *words = shlex.split(line)
        arguments = [word for word in words if not re.search(r"\.\.\.|=[A-Z]+$|^-m$", word)]  # without placeholders
        if name not in COMMANDS:
            wrong.append(f"{line}: no command {name}")
            continue
        try:
            overrides = translate_flags(COMMANDS[name], arguments)
            check_overrides([one for one in overrides if "=" in one and not one.startswith("-")], schema_of(name), name)
        except UserError as error:
            wrong.append(f"{line}: {error}")
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}/{page.stem}")
def test_every_link_within_the_project_leads_somewhere(page):
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", page.read_text("utf-8")):
        file = page.parent / target if target else page
        assert file.exists(), target
        if anchor:
            text = file.read_text("utf-8")
            headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
            places = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in places | set(re.findall(r'<a (?:id|name)="([^"]*)"', text))


def test_the_tables_of_the_papers_name_files_and_functions_that_exist():
    folder, checked = ROOT, 0
    for cell in re.findall(r"\|([^|\n]*`[^|\n]*)", (ROOT / "docs/papers.md").read_text("utf-8")):
        names: list[str] = []
        for word in re.findall(r"`([\w./]+)`", cell):
            if re.search(r"\.(py|h|cuh?|cpp)$|/$", word):
                path = ROOT / word if "/" in word else folder / word
                assert path.exists(), word
                folder, text = path.parent, path.read_text("utf-8") if path.is_file() else ""
                for name in names:
                    assert re.search(rf"(?:def|class) {name}\b|^    {name}:", text, re.MULTILINE), f"{name} in {word}"
                checked, names = checked + 1 + len(names), []
            elif re.fullmatch(r"[a-zA-Z_]+", word) and (ROOT / "snarfcli").name in cell:
                names.append(word)
    assert checked > 60
