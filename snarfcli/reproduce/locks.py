"""Locks between processes: two jobs never make the same samples or train the same run at once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

__all__ = ["locked", "one_of"]

_LOOK_EVERY_S = 0.3


@contextmanager
def locked(path: Path, check: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold the lock of a file; another process that wants it waits. It is free again when its holder ends, however it ends.

    Args:
        path: the file; it and its folder are made.
        check: called while waiting; what it raises ends the waiting.
    """
    with one_of([path], check):
        yield


@contextmanager
def one_of(paths: Sequence[Path], check: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold the lock of any one of several files, which bounds how many processes work at once; see `locked`."""
    descriptor = None
    while descriptor is None:
        descriptor = next((one for one in map(_try, paths) if one is not None), None)
        if descriptor is None:
            check()
            time.sleep(_LOOK_EVERY_S)
    try:
        yield
    finally:
        os.close(descriptor)


def _try(path: Path) -> int | None:
    """Return the open and locked file, or None if another process has it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        import fcntl
    except ImportError:  # Windows: nothing is locked, which matters only where two plans share runs
        return descriptor
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except OSError:  # a file system without locks
        return descriptor
    return descriptor
