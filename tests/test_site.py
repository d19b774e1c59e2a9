"""The documentation as a site: what is generated for it, its links, and that it builds without warnings."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import room_graph
from chromium_page import needs_chromium, opened
from configuration import configuration_page
from filelock import FileLock
from links import rewrite_links
from pages import API_ROOMS, page_of, project_pages

from snarfcli.cli.command_list import COMMAND_LIST
from snarfcli.hydra_config.schema import setting_names

ROOT = Path(__file__).parents[1]
PAGES = {"data/README.md": "data.md", "README.md": "index.md", "examples/rays.py": "examples/rays.md"}


@pytest.fixture(scope="module")
def configuration() -> str:
    return configuration_page()


def test_the_configuration_has_every_setting_and_option(configuration):
    for command in (one for one in COMMAND_LIST if not one.is_hidden):
        module = importlib.import_module(f"snarfcli.commands.{command.module}")
        rows = set(re.findall(r"^\| `([\w.]+)` \|", configuration, re.MULTILINE))
        groups = {name.partition(".")[0] for name in rows if "." in name}
        assert {name for name in setting_names(getattr(module, command.schema)) if name not in rows | groups} == set()
    for path in (ROOT / "conf").glob("*/*.yaml"):
        if path.parent.name not in ("common", "reproduce"):
            assert f"- `{path.parent.name}={path.stem}`: " in configuration


def test_values_types_and_descriptions_are_those_of_the_command(configuration):
    rows = {line.split(" | ")[0]: line for line in configuration.splitlines() if line.startswith("| `")}
    assert "| `threads` | `int or None` | `null` | Threads for tensor work; null keeps PyTorch's choice. |" in configuration
    options = sorted(path.stem for path in (ROOT / "conf/training").glob("*.yaml"))
    steps = rows["| `training.steps`"].split(" | ")
    assert steps[2 + options.index("quick")] == "`1200`"
    assert steps[2 + options.index("paper")] == "`45000`"
    assert "&lt;data&gt;" in configuration  # not a tag
    widths = [len(line.split(" | ")) for line in configuration.splitlines() if line.startswith("| `training.")]
    assert set(widths) == {len(options) + 3}


@pytest.mark.parametrize(
    ("text", "source", "site", "expected"),
    [
        ("[a](../data/README.md#x)", "docs/library.md", "library.md", "[a](data.md#x)"),
        ("[a](../../README.md)", "docs/results/tried.md", "results/tried.md", "[a](../index.md)"),
        ("![a](docs/gallery/b.png)", "README.md", "index.md", "![a](gallery/b.png)"),
        ("[`a`](../examples/rays.py)", "docs/library.md", "library.md", "[`a`](examples/rays.md)"),
        ("[a](LICENSE) b", "README.md", "index.md", "a b"),
        ("[a](https://b.c/d.md) [e](#f)", "README.md", "index.md", "[a](https://b.c/d.md) [e](#f)"),
        ("```\n[a](LICENSE)\n```\n[a](LICENSE)", "README.md", "index.md", "```\n[a](LICENSE)\n```\na"),
        ("a\n\n    x[0](LICENSE)\n\n[a](LICENSE)", "README.md", "index.md", "a\n\n    x[0](LICENSE)\n\na"),
    ],
)
def test_links_lead_to_pages_of_the_site(text, source, site, expected):
    assert rewrite_links(text, source, site, PAGES)[0] == expected


def test_pages_beside_docs_are_found():
    found = project_pages(ROOT)
    assert {"README.md", "CONTRIBUTING.md", "data/README.md", "examples", "examples/rays.py"} <= set(found)
    assert all((ROOT / source).exists() for source in found)
    overview = page_of(ROOT / "examples")
    for path in (ROOT / "examples").glob("*.*py*"):
        assert f"[{path.name}](examples/{path.name})" in overview
    page = page_of(ROOT / "examples/rays.py")
    assert (ROOT / "examples/rays.py").read_text() in page
    assert page.startswith("# rays.py\n\nLearn a canonical field")


def test_modules_of_the_reference_exist():
    for room in API_ROOMS:
        assert importlib.import_module(f"snarf.{room}").__all__ or room == "errors"


def test_flowcharts_become_pictures():
    text = 'a\n\n```mermaid\nflowchart TD\n    x --> y & z\n    y -.-> w[("two words")]\n```\n\nb\n'
    drawn = room_graph.draw_graphs(text)
    assert drawn.startswith("a\n\n<svg ")
    assert drawn.count("<rect") == drawn.count("<text") == 4
    assert drawn.count('<path d="M') == 3 + 1  # and the head of the arrows
    assert drawn.count("dasharray") == 1
    assert ">two words</text>" in drawn
    heights = dict(zip(re.findall(r">([\w ]+)</text>", drawn), re.findall(r'<text x="\d+" y="(\d+)"', drawn), strict=True))
    assert int(heights["x"]) < int(heights["y"]) == int(heights["z"]) < int(heights["two words"])
    with pytest.raises(ValueError, match="flowchart: wanted a name"):
        room_graph.draw_graphs("```mermaid\nflowchart TD\n    x --> [y]\n```\n")


@pytest.fixture(scope="session")
def site(tmp_path_factory) -> Path:
    """The site, built once for all processes of the test run."""
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None:
        pytest.skip("needs the packages of the extra docs")
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "site"
    with FileLock(f"{folder}.lock"):
        built = folder.with_suffix(".built")
        if not built.exists():
            build_site(folder)
            built.touch()
    return folder


def build_site(folder: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder), "-f", str(ROOT / "mkdocs.yml")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "true", "NO_COLOR": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_site_builds_without_warnings_and_loads_nothing(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    loaded = re.compile(
        r"<(?:script|img|iframe)\b[^>]*\bsrc=\"?(https?:|//)|<link\b[^>]*rel=\"?(?:stylesheet|preconnect|icon)[^>]*https?:"
    )
    for page in pages:
        text = page.read_text("utf-8")
        assert loaded.search(text) is None, page
        assert 'class="mermaid"' not in text, page  # Material would load a script to draw it
    for room in API_ROOMS:
        text = (site / f"api/{room}.html").read_text("utf-8")
        for name in _public_names(room):
            assert f'id="snarfcli.{room}.{name}"' in text, name


def _public_names(room: str) -> list[str]:
    """Return the documented classes and functions of a module."""
    module: Any = importlib.import_module(f"snarfcli.{room}")
    names = getattr(module, "__all__", [])
    return [name for name in names if isinstance(getattr(module, name), type) or callable(getattr(module, name))]


def test_the_search_of_the_site_knows_its_pages(site):
    index = (site / "search/search_index.js").read_text("utf-8")
    for place in (
        "first_avatar.html",
        "papers.html",
        "api/deformer.html#snarfcli.deformer.ForwardDeformer",
        "configuration.html",
    ):
        assert f'"location":"{place}' in index


@needs_chromium
def test_search_finds_pages_of_a_site_on_the_disk(site, tmp_path):
    """There browsers allow no workers; docs/site/iframe-worker.js stands in for them."""
    with opened(f"{(site / 'index.html').as_uri()}?q=broyden", tmp_path) as page:
        page.wait("document.querySelectorAll('.md-search-result__item').length > 3")
        assert page.complaints == []
        assert all(address.startswith(("file:", "data:", "about:", "blob:")) for address in page.requests)
