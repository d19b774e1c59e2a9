"""The table of platforms, and the workflows of continuous integration: they call targets that exist."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.fixture(scope="module")
def platforms() -> ModuleType:
    spec = importlib.util.spec_from_file_location("platforms", ROOT / "tools" / "platforms.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["platforms"] = module  # as dataclasses need
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (
            "cause: Because all versions of embreex have no wheels with a matching platform tag (`manylinux_2_39_aarch64`)",
            "no wheel of embreex",
        ),
        (
            "Because pymeshlab>=2023.12,<=2025.7 has no wheels with a matching\n  Python ABI tag (e.g., `cp314`) and only\n"
            "the following versions: And because pymeshlab==2025.7.post1 has no wheels with a matching platform tag",
            "no wheel of pymeshlab",
        ),
        ("error: cannot reach\nthe index", "error: cannot reach the index"),
    ],
)
def test_the_missing_package_is_named(platforms, error, reason):
    assert platforms.missing(error) == reason


def table(platforms, *lost: str) -> str:
    """Return the page where everything resolves but the platforms named."""
    found, none = platforms.Cell({"torch": "2.15.0"}, ""), platforms.Cell({}, "no wheel of embreex")
    return platforms.page({
        (extra, python, platform): none if platform.title in lost else found
        for extra in platforms.EXTRAS
        for python in platforms.PYTHONS
        for platform in platforms.PLATFORMS
    })  # fmt: skip


def test_only_what_resolved_before_is_reported_as_lost(platforms):
    everything, less = table(platforms), table(platforms, "Linux ARM")
    assert platforms.lost_cells(everything, everything) == []
    assert platforms.lost_cells(less, everything) == []
    lost = platforms.lost_cells(everything, less)
    assert len(lost) == len(platforms.EXTRAS) * len(platforms.PYTHONS)
    assert lost[0] == "3.10 | yes | no wheel of embreex | yes | yes | yes"


def test_the_stored_table_has_every_cell_and_says_what_is_missing(platforms):
    text = platforms.TABLE.read_text(encoding="utf-8")
    rows = [row.split(" | ") for row in platforms.table_rows(text)]
    assert [row[0] for row in rows] == list(platforms.PYTHONS) * len(platforms.EXTRAS)
    assert all(cell == "yes" or cell.startswith("no wheel of ") for row in rows for cell in row[1:])
    assert all(len(row) == 1 + len(platforms.PLATFORMS) for row in rows)
    everywhere = rows[: len(platforms.PYTHONS)] + rows[-len(platforms.PYTHONS) :]
    assert {cell for row in everywhere for cell in row[1:]} == {"yes"}  # without extras, and without MeshLab
    assert text.startswith(platforms.INTRODUCTION)


def called(text: str) -> list[str]:
    """Return the targets of make that commands call."""
    return re.findall(r"^(?: *(?:- )?run: )?\s*make (?:PYTHON=\S+ )?([\w-]+)", text, re.MULTILINE)


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_call_targets_and_files_that_exist(path):
    workflow = yaml.safe_load(path.read_text(encoding="utf-8"))
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    commands = [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]
    assert {target for command in commands for target in called(command)} <= targets
    assert {name for command in commands for name in re.findall(r"tools/\S+", command) if not (ROOT / name).is_file()} == set()
    assert all(
        job["runs-on"] and ("strategy" in job or "matrix" not in str(job["runs-on"])) for job in workflow["jobs"].values()
    )


def test_what_is_checked_is_what_the_project_says():
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "checks.yml").read_text(encoding="utf-8"))["jobs"]
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    pythons = jobs["test"]["strategy"]["matrix"]["python"]
    assert f'requires-python = ">={pythons[0]}"' in project
    assert len(jobs["test"]["strategy"]["matrix"]["system"]) == 3
    text = "".join(path.read_text(encoding="utf-8") for path in WORKFLOWS)
    assert {"lint", "test", "lowest", "wheels"} <= set(called(text))
    assert "test-command" in project
    assert (ROOT / "tools" / "check_wheel.py").is_file()
