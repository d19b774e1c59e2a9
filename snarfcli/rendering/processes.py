"""How many processes make frames at the same time."""

from __future__ import annotations

from pathlib import Path

from snarfcli.errors import UserError
from snarfcli.parallel import count_cores

__all__ = ["choose_processes", "parse_processes"]

_MOST = 64
# A process starts in about three seconds; fewer frames than this each are made sooner without it.
_LEAST_FRAMES = 6
_BYTES_EACH = 2**30  # PyTorch, a paper-sized network, and the lattice and mesh of resolution 256
_BYTES_A_CELL = 12  # of lattices, along the longest side cubed; a body fills a fifth of its cube or less


def parse_processes(text: str) -> int | None:
    """Return the number of processes that a setting names, None for auto.

    Raises:
        UserError: it is neither auto nor a number in range.
    """
    word = str(text).strip().lower()
    if word == "auto":
        return None
    if not (word.isdecimal() and 1 <= int(word) <= _MOST):
        raise UserError(f"processes must be auto or a number from 1 to {_MOST}, got '{text}'")
    return int(word)


def choose_processes(wanted: int | None, frames: int, resolution: int, *, extract: bool = True, draw: bool = True) -> int:
    """Return how many processes make frames.

    Args:
        wanted: what the user said; None to have it chosen: one a core, as memory and frames allow.
        frames: how many there are to make.
        resolution: cells along the longest side of the surface.
        extract: whether they extract surfaces; with a GPU only one process does.
        draw: whether they draw pictures.
    """
    if not (extract or draw):
        return 1
    if wanted is not None:
        return min(wanted, frames)
    each = _BYTES_EACH + (_BYTES_A_CELL * resolution**3 // 4 if extract else 0)
    return max(1, min(count_cores(), _free_bytes() // each, frames // _LEAST_FRAMES, _MOST))


def _free_bytes() -> int:
    """Return the memory that is free for use, bytes; very much where the system does not say."""
    facts = Path("/proc/meminfo")
    if facts.is_file():
        for line in facts.read_text(errors="replace").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    return 2**50
