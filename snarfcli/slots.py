"""Slots: numbers of the processes that run at the same time, from 0, by which they share the GPUs of a machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["SLOT_VARIABLE", "current_slot", "use_slot"]

SLOT_VARIABLE = "SNARF_GPU_SLOT"
"""Environment variable with the slot of a process."""


def current_slot() -> int:
    """Return the slot of this process; 0 if it has none.

    Raises:
        ValueError: the environment variable is no number; the message is one line.
    """
    text = os.environ.get(SLOT_VARIABLE, "")
    if text and not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise ValueError(f"{SLOT_VARIABLE}: wanted a whole number from 0, got {text[:40]!r}; correct or unset it")
    return int(text) if text else 0


@contextmanager
def use_slot(slot: int) -> Iterator[None]:
    """Give this process, and those that it starts, a slot while the block runs."""
    before = os.environ.get(SLOT_VARIABLE)
    os.environ[SLOT_VARIABLE] = str(slot)
    try:
        yield
    finally:
        if before is None:
            del os.environ[SLOT_VARIABLE]
        else:
            os.environ[SLOT_VARIABLE] = before
