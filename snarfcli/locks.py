"""Locks of files between processes, which child processes inherit.

A lock is free as soon as its holder and the children that inherited it have ended, however they ended.
"""

from __future__ import annotations

import errno
import itertools
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout

__all__ = ["can_lock", "hold_slot", "inherited_locks", "locked", "try_lock"]

log = logging.getLogger(__name__)

_LOOK_EVERY_S = 0.3
# What file systems without locks answer, such as Lustre, NFS and shared folders mounted without them.
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
_held: set[int] = set()


@contextmanager
def locked(path: Path, check: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold the lock of a file while the block runs; wait while another process holds it.

    The lock is released when its holder, and the children that inherited it, have ended, including when they are killed.

    Args:
        path: the file; it and its folder are created.
        check: called repeatedly while waiting; an exception from it ends the waiting.
    """
    with _first_free(lambda: [path], check):
        yield


@contextmanager
def hold_slot(folder: Path, most: int | None = None, check: Callable[[], None] = lambda: None) -> Iterator[int]:
    """Hold the lowest number, from 0, that no other process of this machine holds in a folder, and yield it.

    Args:
        folder: the folder; it is created.
        most: how many numbers there are; wait while all are held. None for any number. It limits how many processes work at
            the same time.
        check: as in `locked`.
    """

    def paths() -> Iterator[Path]:
        numbers = itertools.count() if most is None else range(most)
        return (folder / f"{socket.gethostname()}.slot{number}" for number in numbers)

    with _first_free(paths, check) as slot:
        yield slot


@contextmanager
def _first_free(paths: Callable[[], Iterable[Path]], check: Callable[[], None]) -> Iterator[int]:
    """Hold the lock of the first file that no other process has locked, and yield its place; wait while all are locked."""
    while True:
        for place, path in enumerate(paths()):
            release = try_lock(path)
            if release is not None:
                try:
                    yield place
                finally:
                    release()
                return
        check()
        time.sleep(_LOOK_EVERY_S)


def try_lock(path: Path) -> Callable[[], None] | None:
    """Lock a file and return the function that unlocks it, or None if another process holds the lock.

    On a file system without locks nothing is locked: a warning says so once, and work goes on.

    Args:
        path: the file; it and its folder are created.

    Raises:
        OSError: the file cannot be created.
    """
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptors: list[int] = []
        # A soft lock would replace a missing one by a file, which stays when its holder is killed on another machine.
        lock = FileLock(path, fallback_to_soft=False, on_acquired=descriptors.append)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            return None
        except FileNotFoundError:  # its folder was deleted at this moment
            continue
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            _warn_once(str(path.parent), error.errno)
            return lambda: None
        if _is_still_there(path, descriptors):
            break
        lock.release()
    _held.update(descriptors)

    def release() -> None:
        _held.difference_update(descriptors)
        with suppress(OSError):  # while it is locked, see `_is_still_there`; Windows deletes no open file
            path.unlink()
        lock.release()

    return release


def _is_still_there(path: Path, descriptors: Iterable[int]) -> bool:
    """Return whether a path is still the file that was locked: its holder deletes it, while another may have opened it."""
    try:
        return all(os.path.samestat(os.fstat(descriptor), path.stat()) for descriptor in descriptors)
    except OSError:
        return os.name != "posix"


def inherited_locks() -> tuple[int, ...]:
    """Return the descriptors of the locks that this process holds, to be passed to the child processes that write for it."""
    return tuple(_held) if os.name == "posix" else ()


def can_lock(folder: Path) -> bool:
    """Return whether the file system of a folder has locks.

    Raises:
        OSError: nothing can be written there.
    """
    path = folder / f".snarf-{os.getpid()}.lock"
    first = try_lock(path)
    second = try_lock(path)
    for release in (second, first):
        if release is not None:
            release()
    return second is None


@cache
def _warn_once(folder: str, code: int) -> None:
    log.warning(
        "warning: the file system of %s cannot lock files (%s); do not run two commands on the same samples or run at once",
        folder, os.strerror(code),
    )  # fmt: skip
