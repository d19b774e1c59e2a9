"""Names that people gave to things, as names of folders and files."""

from __future__ import annotations

import re
from collections.abc import Iterable

__all__ = ["folder_name", "folder_names"]

_LONGEST = 80
"""Letters of a name; systems take 255 bytes of a name, of which a letter may need three."""


def folder_name(name: str, otherwise: str = "clip") -> str:
    """Return a name that can be a folder or the stem of a file on any system; `otherwise` if nothing is left of it."""
    return _cleaned(name) or otherwise


def folder_names(names: Iterable[str]) -> list[str]:
    """Return names that can be folders on any system, each once, whatever the letter case."""
    made: list[str] = []
    taken: set[str] = set()
    for name in names:
        base = name = folder_name(name)
        number = 1
        while name.lower() in taken:
            number += 1
            ending = f"_{number}"
            name = base[: _LONGEST - len(ending)] + ending
        made.append(name)
        taken.add(name.lower())
    return made


def _cleaned(name: str) -> str:
    """Return what of a name any system takes: no dot at an end, which hides it, climbs to the parent or is dropped."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:_LONGEST].rstrip("._")
