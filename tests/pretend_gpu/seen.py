"""What happened on the pretend device while it was watched, and the lines of the code that made it happen."""

from __future__ import annotations

import json
import re
import sys
import sysconfig
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

import snarfcli

__all__ = ["Seen", "current_line", "is_watched", "note", "note_kernels", "watching"]

_PACKAGE = str(Path(snarfcli.__file__).parent) + "/"
_NOT_A_CALLER = (
    *(str(Path(file).parent) + "/" for file in (torch.__file__, sysconfig.__file__, __file__)),  # the last: this folder
    "<frozen",
)
_ENTRY = re.compile(r'\s*File "([^"]+)", line (\d+), in (\S+)')  # of traceback.format_stack
_MOST_LINES = 3


@dataclass
class Seen:
    """Events of one `watch`. Each text is "what: file:line function < its callers"; lines of snarfcli if there are any."""

    name: str = ""
    """Of the watch."""
    mixing: list[str] = field(default_factory=list)
    """Operators that got tensors of different devices and would fail on a GPU."""
    waits: list[str] = field(default_factory=list)
    """Operators for which the host would wait until the GPU has done everything before."""
    copies: list[str] = field(default_factory=list)
    """Copies from pageable host memory to the GPU."""
    launches: Counter[str] = field(default_factory=Counter)
    """Estimated number of kernels, by operator and line."""

    @property
    def kernels(self) -> int:
        """Estimated number of kernel launches."""
        return sum(self.launches.values())

    def append_to(self, file: str | None) -> None:
        """Write the events to the end of a file, as one line that `read_all` reads."""
        if file:
            with open(file, "a") as lines:
                print(json.dumps(vars(self)), file=lines)

    @classmethod
    def read_all(cls, file: Path) -> list[Seen]:
        """Return all that `append_to` has written."""
        found = [cls(**json.loads(line)) for line in file.read_text().splitlines()]
        return [replace(seen, launches=Counter(seen.launches)) for seen in found]

    def lines(self) -> Iterator[str]:
        """Yield a summary, and every event with its number."""
        counts = f"{len(self.mixing)} mixing, {len(self.waits)} waits, {len(self.copies)} copies, ~{self.kernels} kernels"
        yield f"{self.name or 'watched'}: {counts}"
        for kind in ("mixing", "waits", "copies"):
            yield from (f"  {kind} x{count} {what}" for what, count in Counter(getattr(self, kind)).most_common())


_seen: list[Seen] = []


@contextmanager
def watching(name: str) -> Iterator[Seen]:
    """Note what happens on the device, in all threads."""
    seen = Seen(name)
    _seen.append(seen)
    try:
        yield seen
    finally:
        _seen[:] = [one for one in _seen if one is not seen]


def is_watched() -> bool:
    """Return whether what happens is noted."""
    return bool(_seen)


def note(kind: str, what: str) -> None:
    """Note a text of "mixing", "waits" or "copies"."""
    for seen in _seen:
        getattr(seen, kind).append(what)


def note_kernels(line: str, count: int) -> None:
    """Note the number of kernels that a line has started."""
    for seen in _seen:
        if count:
            seen.launches[line] += count


def current_line() -> str:
    """Return the innermost lines of snarfcli that are being executed; without any, of the program that uses it.

    In the backward pass of an operator that Python does not call, they are those that called it in the forward pass.
    """
    frame, lines, caller = sys._getframe(1), [], None
    while frame is not None and len(lines) < _MOST_LINES:
        is_of_package, file = _place(frame.f_code.co_filename)
        if file and (is_of_package or caller is None):
            line = f"{file}:{frame.f_lineno} {frame.f_code.co_name}"
            lines, caller = ([*lines, line], caller) if is_of_package else (lines, line)
        frame = frame.f_back
    node = None if lines or caller else torch._C._current_autograd_node()
    return " < ".join(lines) or caller or ("unknown" if node is None else _line_of_node(node))


def _line_of_node(node: Any) -> str:
    """Return the name of a node of the backward pass, and the lines that made it, where PyTorch kept them (see `watch`)."""
    lines, callers = [], []
    for text in reversed((getattr(node, "metadata", None) or {}).get("traceback_", [])):
        match = _ENTRY.match(text)
        is_of_package, file = _place(match[1]) if match else (False, None)
        if match and file:
            (lines if is_of_package else callers).append(f"{file}:{match[2]} {match[3]}")
    return f"backward of {node.name()} < {' < '.join(lines[:_MOST_LINES] or callers[:1]) or 'unknown'}"


@cache
def _place(file: str) -> tuple[bool, str | None]:
    """Return whether a file is of the package, and its name in a report: None for files of PyTorch, Python and this folder."""
    if file.startswith(_PACKAGE):
        return True, f"snarfcli/{file.removeprefix(_PACKAGE)}"
    return False, None if file.startswith(_NOT_A_CALLER) else Path(file).name
