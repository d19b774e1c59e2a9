"""Unique names, and names of folders and files made from the names of things."""

from __future__ import annotations

import re
from collections.abc import Iterable

__all__ = ["folder_name", "folder_names", "unique_names"]

_LONGEST = 80
"""Maximum number of letters of a file name; systems allow 255 bytes, and a letter may take three."""


def unique_names(names: Iterable[str], *, longest: int | None = None, ignore_case: bool = False) -> list[str]:
    """Return the names in order; a name that is taken already gets the first free number: walk, walk_2, walk_3.

    Args:
        names: any strings.
        longest: maximum number of letters of a numbered name, whose front is shortened to it; None for no limit.
        ignore_case: whether names that differ only in the case of letters count as equal.
    """
    unique: list[str] = []
    taken: set[str] = set()
    numbers: dict[str, int] = {}  # the last number given to a name; all before it are taken
    for name in names:
        base = name.lower() if ignore_case else name
        numbered = name
        while (key := numbered.lower() if ignore_case else numbered) in taken:
            numbers[base] = numbers.get(base, 1) + 1
            ending = f"_{numbers[base]}"
            numbered = (name if longest is None else name[: longest - len(ending)]) + ending
        unique.append(numbered)
        taken.add(key)
    return unique


def folder_name(name: str, otherwise: str = "clip") -> str:
    """Return a name that is valid for a folder or the stem of a file on any system; `otherwise` if no letter is valid."""
    return _cleaned(name) or otherwise


def folder_names(names: Iterable[str]) -> list[str]:
    """Return unique names that are valid for folders on any system, also where the case of letters does not count."""
    return unique_names(map(folder_name, names), longest=_LONGEST, ignore_case=True)


def _cleaned(name: str) -> str:
    """Return the valid part of a name, without dots at its ends: they hide it, climb to the parent or are dropped."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:_LONGEST].rstrip("._")
