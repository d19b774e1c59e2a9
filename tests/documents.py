"""The Python examples in the documentation, and running them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

__all__ = ["python_examples", "run_examples"]


def python_examples(document: Path) -> list[str]:
    """Return the blocks of Python code of a Markdown file."""
    return re.findall(r"^```python\n(.*?)^```", document.read_text(), re.MULTILINE | re.DOTALL)


def run_examples(document: Path, examples: list[str]) -> dict[str, Any]:
    """Run blocks one after the other as one program; return its names."""
    names: dict[str, Any] = {"__name__": "example"}
    for text in examples:
        exec(compile(text, document.name, "exec"), names)
    return names
