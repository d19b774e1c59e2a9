"""The layers of the package: a room imports only rooms of lower layers, and there are no circular imports."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import snarfcli

PACKAGE = Path(snarfcli.__file__).parent
LAYERS = (
    ("cli",),
    ("commands",),
    ("reproduce",),
    ("training", "viewer"),
    ("avatar", "evaluation", "fitting", "scanned_subjects"),
    ("export", "registration", "rendering", "samples"),
    ("datasets", "meshing"),
    ("models", "motions"),
    ("deformer", "shape"),
    ("bodies", "draws", "networks", "point_clouds"),
    (
        "array_files",
        "checks",
        "constants",
        "descriptions",
        "formats",
        "hydra_config",
        "native",
        "output_locks",
        "parallel",
        "precision",
        "progress",
        "runs",
        "sampling",
        "segments",
    ),
    ("devices", "extras", "files", "locks"),
    ("errors", "field_docs", "interrupts", "names", "safe_start", "slots", "texts", "versions"),
)
"""Folders and top-level modules of the package, from the top layer down; those of one layer do not import each other."""

HEIGHT = {room: len(LAYERS) - level for level, rooms in enumerate(LAYERS) for room in rooms}


def modules() -> dict[str, Path]:
    """Return the file of each module, by module name; the package's own `__init__` and `__main__` are left out."""
    paths = {path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", "."): path for path in PACKAGE.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in paths.items() if name not in ("__init__", "__main__")}


def imported(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Yield the modules of the package that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("snarfcli."):
            base = (node.module or "").removeprefix("snarfcli.")
            for name in node.names:
                yield f"{base}.{name.name}" if f"{base}.{name.name}" in known else base
        elif isinstance(node, ast.Import):
            yield from (name.name.removeprefix("snarfcli.") for name in node.names if name.name.startswith("snarfcli."))


def room(module: str) -> str:
    return module.partition(".")[0]


def test_every_room_has_a_layer():
    assert {room(module) for module in modules()} == set(HEIGHT)


@pytest.mark.parametrize("name", sorted(HEIGHT))
def test_a_room_imports_only_lower_rooms(name):
    known = modules()
    for module, path in known.items():
        if room(module) != name:
            continue
        for other in imported(path, known):
            assert room(other) == name or HEIGHT[room(other)] < HEIGHT[name], f"{module} imports {other}"


def test_there_is_no_circle():
    known = modules()
    graph = {module: {other for other in imported(path, known) if other != module} for module, path in known.items()}
    for package in [name for name in known if known[name].name == "__init__.py"]:
        graph[package] = set()  # it re-exports its own modules, which may import it
    assert len(list(TopologicalSorter(graph).static_order())) == len(known)


def test_the_documented_layers_are_these():
    text = (PACKAGE.parent / "docs" / "architecture.md").read_text()
    rows = [row for row in text.splitlines() if re.match(r"\| \d+ \|", row)]
    documented = [tuple(re.findall(r"`(\w+)`", row.split("|")[2])) for row in rows]
    assert documented == list(LAYERS)
