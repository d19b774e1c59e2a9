"""Locks between processes: two of them never write the same samples or train the same run at the same time."""

from __future__ import annotations

import errno
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout

__all__ = ["locked", "one_of", "try_lock"]

log = logging.getLogger(__name__)

_LOOK_EVERY_S = 0.3
# What file systems without locks answer, such as Lustre, NFS and shared folders mounted without them.
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)


@contextmanager
def locked(path: Path, check: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold the lock of a file while the block runs; wait while another process holds it.

    The lock is released when its holder ends, including when it is killed.

    Args:
        path: the file; it and its folder are created.
        check: called repeatedly while waiting; an exception from it ends the waiting.
    """
    with one_of([path], check):
        yield


@contextmanager
def one_of(paths: Sequence[Path], check: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold the lock of any one of several files, which limits how many processes work at the same time; see `locked`."""
    release = None
    while release is None:
        release = next((one for one in map(try_lock, paths) if one is not None), None)
        if release is None:
            check()
            time.sleep(_LOOK_EVERY_S)
    try:
        yield
    finally:
        release()


def try_lock(path: Path) -> Callable[[], None] | None:
    """Lock a file and return the function that unlocks it, or None if another process holds the lock.

    On a file system without locks nothing is locked: a warning says so once, and work goes on.

    Args:
        path: the file; it and its folder are created.

    Raises:
        OSError: the file cannot be created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # A soft lock would replace a missing one by a file, which stays when its holder is killed on another machine.
    lock = FileLock(path, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        return None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        _warn_once(str(path.parent), error.errno)
        return lambda: None
    return lock.release


@cache
def _warn_once(folder: str, code: int) -> None:
    log.warning(
        "warning: the file system of %s cannot lock files (%s); do not run two commands on the same samples or run at once",
        folder, os.strerror(code),
    )  # fmt: skip
