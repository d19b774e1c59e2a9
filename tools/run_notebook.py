"""Run the code of a notebook from top to bottom, without Jupyter.

    python tools/run_notebook.py examples/first_avatar.ipynb
    python tools/run_notebook.py examples/first_avatar.ipynb training=smoke   # another value for a variable of the first cell

Lines that start with ! are commands, in which {name} stands for a variable, as in Jupyter. The notebook is not changed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

__all__ = ["cells", "run_notebook"]


def cells(path: Path, kind: str = "code") -> list[str]:
    """Return the texts of the cells of one kind, code or markdown."""
    notebook = json.loads(path.read_text("utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def run_notebook(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Run the cells of code in the current folder and return the names that they define.

    Args:
        path: of the notebook.
        values: replace those of variables of the first cell of code.

    Raises:
        KeyError: the first cell does not have a variable of `values`.
        subprocess.CalledProcessError: a command failed.
    """
    names: dict[str, Any] = {"__name__": "notebook", "_command": _command}
    for number, text in enumerate(cells(path)):
        print(f"--- cell {number + 1}\n{text}\n---", flush=True)
        exec(compile(_as_python(text), f"{path.name}, cell {number + 1}", "exec"), names)
        if number == 0:
            for name, value in values.items():
                if name not in names:
                    raise KeyError(f"{path.name}: the first cell has no variable {name}")
                names[name] = value
    return names


def _as_python(text: str) -> str:
    """Return the code of a cell with commands as calls."""
    lines = [f"_command({line[1:].strip()!r}, globals())" if line.startswith("!") else line for line in text.splitlines()]
    return "\n".join(lines)


def _command(line: str, names: dict[str, Any]) -> None:
    """Run a command line; `snarf` is that of this Python."""
    line = line.format_map(names)
    if line.startswith("snarf "):
        line = f'"{sys.executable}" -m snarf {line.removeprefix("snarf ")}'
    subprocess.run(line, shell=True, check=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Run the code of a notebook from top to bottom.")
    parser.add_argument("notebook", type=Path)
    parser.add_argument("values", nargs="*", metavar="NAME=VALUE", help="for variables of the first cell")
    options = parser.parse_args()
    os.environ.setdefault("MPLBACKEND", "agg")
    run_notebook(options.notebook, dict(value.split("=", 1) for value in options.values))
