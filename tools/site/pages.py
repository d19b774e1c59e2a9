"""Pages of the site that stand beside docs/: the README, data, contributing, examples, benchmarks, and the API reference."""

from __future__ import annotations

import ast
import json
from pathlib import Path

__all__ = ["api_pages", "page_of", "project_pages"]

_NAMED = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "data/README.md": "data.md",
}
API_ROOMS = {
    "avatar": "The trained avatar: its field, surfaces and characters",
    "bodies": "Skeletons and bodies",
    "deformer": "Forward skinning and correspondences",
    "networks": "Networks with native kernels",
    "shape": "Canonical shapes",
    "motions": "Motions and motion files",
    "meshing": "Surfaces",
    "export.bvh": "Motions as BVH",
    "export.character": "Options of characters",
    "export.clips": "Clips of characters",
    "export.vrm": "VRM characters",
    "errors": "User errors",
}
"""Public modules of the package, and what they are for."""
_API_PAGE = """# snarf.{room}

{purpose}. `snarf.{room}` is the module `{module}` by its short name.

::: {module}
    options:
      show_root_heading: false
      show_root_toc_entry: false
"""


def project_pages(root: Path) -> dict[str, str]:
    """Return the files of the project that are pages of the site, besides those in docs/, with the page of each."""
    found = {source: page for source, page in _NAMED.items() if (root / source).is_file()}
    found["benchmarks/results"] = "benchmarks/index.md"
    for path in sorted((root / "benchmarks/results").glob("*.md")):
        found[f"benchmarks/results/{path.name}"] = f"benchmarks/{path.name}"
    found["examples"] = "examples/index.md"
    for path in sorted((root / "examples").glob("*.*")):
        if path.suffix in (".py", ".ipynb"):
            found[f"examples/{path.name}"] = f"examples/{path.stem}.md"
    return found


def api_pages() -> dict[str, str]:
    """Return the pages of the API reference, which mkdocstrings fills from the docstrings."""
    rows = [f"| [`snarf.{room}`]({room}.md) | {purpose} |" for room, purpose in API_ROOMS.items()]
    pages = {"api/index.md": "\n".join([_API_START, "| module | content |", "|---|---|", *rows, ""])}
    for room, purpose in API_ROOMS.items():
        pages[f"api/{room}.md"] = _API_PAGE.format(room=room, purpose=purpose, module=f"snarfcli.{room}")
    return pages


_API_START = """# API reference

Made from the docstrings. The package is called `snarf` as well as `snarfcli`; both names give the same modules and objects.
What is used most can be imported from `snarf` itself: `Avatar`, `Body`, `Skeleton`, `builtin_body`, `load_body`,
`ForwardDeformer`, `CanonicalGrid`, `Correspondences`, `PresetWeights`, `SearchConfig`, `SkinningConfig`,
`find_correspondences`, `find_correspondences_on_field`, `find_correspondences_on_map`, `skin` and `UserError`.

Lengths are in metres, angles in radians. Shapes of arrays are in square brackets: `B` batch, `N` points, `J` joints, `M` roots,
`V` vertices, `F` faces, `D H W` nodes of a grid.
"""


def page_of(path: Path) -> str:
    """Return the page of a file: Markdown as it is, code with its first sentence; or of a folder, a list."""
    if path.is_dir():
        return _list_of_examples(path) if path.name == "examples" else _list_of_pages(path)
    if path.suffix == ".ipynb":
        return _notebook_page(path)
    code = path.read_text("utf-8")
    if path.suffix != ".py":
        return code
    module = ast.parse(code)
    statement = (ast.get_docstring(module) or "").partition("\n\n")[0]
    return f"# {path.name}\n\n{' '.join(statement.split())}\n\n````python\n{code}````\n"


def _list_of_examples(folder: Path) -> str:
    """Return a table of the programs and notebooks of a folder, with the first sentence of each."""
    rows = []
    for path in sorted(folder.glob("*.py")):
        text = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").partition("\n\n")[0]
        rows.append(f"| [{path.name}](examples/{path.name}) | {' '.join(text.split())} |")
    for path in sorted(folder.glob("*.ipynb")):
        title = "".join(_cells(path)[0]["source"]).partition("\n")[0].lstrip("# ")
        rows.append(f"| [{path.name}](examples/{path.name}) | {title} (notebook) |")
    return "\n".join(
        ["# Examples", "", "Run them with `python examples/NAME.py`.", "", "| file | shows |", "|---|---|", *rows, ""]
    )


def _list_of_pages(folder: Path) -> str:
    """Return links to the Markdown files of benchmarks/results by their titles."""
    rows = [
        f"- [{path.read_text('utf-8').partition(chr(10))[0].lstrip('# ')}](results/{path.name})"
        for path in sorted(folder.glob("*.md"))
    ]
    return "\n".join(["# Measurements", "", "What the files in `benchmarks/` gave.", "", *rows, ""])


def _notebook_page(path: Path) -> str:
    """Return the text and the code of a notebook."""
    parts = []
    for cell in _cells(path):
        text = "".join(cell["source"]).strip()
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _cells(path: Path) -> list[dict]:
    return json.loads(path.read_text("utf-8"))["cells"]
