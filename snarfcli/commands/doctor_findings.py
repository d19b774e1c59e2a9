"""Lines of the report of `snarf doctor`, and those about what is promised, of which docs/promises.md says more."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from snarfcli.files import find_temporaries
from snarfcli.locks import can_lock
from snarfcli.output_locks import count_killed, outputs_in_use

__all__ = ["Finding", "promises"]


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    text: str
    is_fallback: bool = False
    """Whether the described part is missing, or replaced by a slower one."""


def promises(data_root: Path, output_root: Path) -> Iterator[Finding]:
    """Yield what the commands promise, and whether it holds in these folders."""
    roots = list(dict.fromkeys(root for root in (data_root, output_root) if root.is_dir()))
    yield Finding("files", "appear whole or not at all, and are on the disk before they get their names")
    yield Finding("a second run", "completes what an interrupted or killed one has left, with the same files")
    left = sum(len(find_temporaries(root, recursive=True)) + count_killed(root) for root in roots)
    unfinished = f"{left} temporary files and locks, of running commands or of killed ones, which delete them when run again"
    yield Finding("left behind", unfinished if left else "nothing")
    yield Finding("two at once", "an output folder has one writer; the second is told who it is, or waits with wait=true")
    yield from (_locks(root) for root in roots)
    used = [line for root in roots for line in outputs_in_use(root)]
    yield Finding("in use now", "; ".join(used) if used else "nothing")
    yield Finding("files of others", "are read as plain data, and checked before anything is built; they cannot run code")


def _locks(root: Path) -> Finding:
    """Return whether folders can be locked below a root."""
    if not os.access(root, os.W_OK):
        return Finding("locks", f"not tested: {root} cannot be written to")
    if can_lock(root):
        return Finding("locks", f"work in {root}")
    return Finding("locks", f"do not work in {root}; do not run two commands on one folder there", is_fallback=True)
