"""Locks of outputs: one output folder has one writer at a time, and its child processes count as the writer too.

DESIGN. A lock is a hidden file beside the folder (not in it: folders are replaced as a whole), locked by the system. It is in
the folder only where nothing can be written beside it. Child processes inherit the lock: when the holder is killed, the lock
stays until its children, which may still write, have ended too. A second file says who holds the lock. It only serves messages.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.locks import try_lock
from snarfcli.texts import one_line

__all__ = [
    "clear_killed",
    "count_killed",
    "hold_all_inside",
    "hold_output",
    "holder_is_gone",
    "lock_file",
    "may_be_in_use",
    "outputs_in_use",
]

log = logging.getLogger(__name__)

_LOOK_EVERY_S = 0.3
_TELL_EVERY_S = 60.0
# How long the children of a killed process may take to notice it and end.
_PATIENCE_S = 20.0
_LOCK, _ABOUT = ".lock", ".holder.json"
_INSIDE = "snarf-folder"


@contextmanager
def hold_output(output: str | Path, command: str, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of an output folder, or of an output file, while the block writes there.

    Args:
        output: the folder or file; its parent folders are created, and deleted again if nothing was written there.
        command: who holds it, for the message that another process gets, such as "snarf train".
        wait: whether to wait while another process holds it.

    Raises:
        UserError: another process holds it and `wait` is false; the message says which one and since when.
        OSError: the lock cannot be created.
    """
    output = Path(os.path.realpath(output))
    path, about = lock_file(output), _about(output)
    new_folders = [folder for folder in output.parents if not folder.exists()]
    release = try_lock(path)
    if release is None:
        release = _await(path, about, output, wait)
    try:
        with suppress(OSError):  # a full disk, which the work itself will report
            about.write_text(json.dumps(_myself(command)), encoding="utf-8")
        yield
    finally:
        with suppress(OSError):
            about.unlink(missing_ok=True)
        release()
        with suppress(OSError):  # not empty
            for folder in new_folders:
                folder.rmdir()


def clear_killed(output: str | Path) -> None:
    """Delete the lock of an output whose holder was killed, for commands that then find that there is nothing left to do."""
    if lock_file(Path(os.path.realpath(output))).exists():
        with suppress(UserError), hold_output(output, "snarf"):
            pass


def count_killed(folder: Path) -> int:
    """Return the number of outputs below a folder whose holders were killed, and whose locks are still there."""
    return sum(_is_gone(_read(about)) for about in folder.rglob(f".*{_ABOUT}"))


def holder_is_gone(output: Path) -> bool:
    """Return whether the process that held the lock of an output has been killed; False if that cannot be known."""
    return _is_gone(_read(_about(output)))


def may_be_in_use(output: Path) -> bool:
    """Return whether an output whose lock is free may have a holder: where locks do not work, or not between machines."""
    holder = _read(_about(output))
    return os.name == "posix" and holder is not None and not _is_gone(holder)


def outputs_in_use(folder: Path) -> list[str]:
    """Return one line for each output below a folder that a process holds: which one, by whom and since when.

    Outputs of other users, whose locks may not be opened, are left out.
    """
    lines = []
    for about in sorted(folder.rglob(f".*{_ABOUT}")):
        output = _output(about, _ABOUT)
        with suppress(OSError):
            release = try_lock(lock_file(output))
            if release is None:
                lines.append(f"{output} {_described(_read(about))}")
            else:
                release()
    return lines


@contextmanager
def hold_all_inside(folder: Path, command: str, *, wait: bool = False) -> Iterator[None]:
    """Hold the locks of all outputs below a folder, whose content the block deletes; see `hold_output`."""
    with ExitStack() as held:
        for path in sorted(folder.rglob(f".*{_LOCK}")):
            held.enter_context(hold_output(_output(path, _LOCK), command, wait=wait))
        yield


def lock_file(output: Path) -> Path:
    """Return the file whose lock `hold_output` holds."""
    return _beside(output, _LOCK)


def _about(output: Path) -> Path:
    """Return the file that says who holds the lock of an output."""
    return _beside(output, _ABOUT)


def _beside(output: Path, ending: str) -> Path:
    """Return a hidden file beside an output; in it, if it is the folder of a disk or in a folder that is read-only.

    In a container, only the disk is shared with other containers, and often only the disk can be written to.
    """
    if output.is_dir() and (os.path.ismount(output) or not os.access(output.parent, os.W_OK)):
        return output / f".{_INSIDE}{ending}"
    return output.with_name(f".{output.name}{ending}")


def _output(path: Path, ending: str) -> Path:
    """Return the output of a file that `_beside` has returned."""
    name = path.name[1:].removesuffix(ending)
    return path.parent if name == _INSIDE else path.with_name(name)


def _await(path: Path, about: Path, output: Path, wait: bool) -> Callable[[], None]:
    """Wait for the lock of an output, without `wait` only for what is about to end, and return the function that unlocks it."""
    start, told = time.monotonic(), -_TELL_EVERY_S
    while True:
        holder = _read(about)
        waited = time.monotonic() - start
        is_ending = waited < (_PATIENCE_S if _is_gone(holder) else 1.0)  # or has just begun and not yet said who it is
        if not wait and not (is_ending and (holder is None or _is_gone(holder))):
            raise UserError(f"{output} is in use {_described(holder)}; wait until it ends, or give wait=true, or end it")
        if wait and waited - told >= _TELL_EVERY_S and not is_ending:
            log.info("waiting: %s is in use %s", output, _described(holder))
            told = waited
        time.sleep(_LOOK_EVERY_S)
        release = try_lock(path)
        if release is not None:
            return release


def _myself(command: str) -> dict[str, Any]:
    """Return what the file beside a lock says."""
    since = datetime.now().astimezone().isoformat(timespec="seconds")
    return {"command": command, "pid": os.getpid(), "host": socket.gethostname(), "since": since}


def _read(about: Path) -> dict[str, Any] | None:
    """Return who holds a lock, None if it is not known."""
    with suppress(OSError, ValueError, RecursionError):
        content = json.loads(about.read_text(encoding="utf-8")[:10000])
        if isinstance(content, dict) and all(isinstance(content.get(key), str) for key in ("command", "host", "since")):
            return content if isinstance(content.get("pid"), int) else None
    return None


def _is_gone(holder: dict[str, Any] | None) -> bool:
    """Return whether a holder has ended without a word, as after `kill -9`; only known for processes of this machine."""
    if holder is None or holder["host"] != socket.gethostname() or os.name != "posix":
        return False
    try:
        os.kill(holder["pid"], 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False


def _described(holder: dict[str, Any] | None) -> str:
    """Return who holds a lock, as the end of "is in use"."""
    if holder is None:
        return "by another process"
    command, host, since = (one_line(holder[key], 60) for key in ("command", "host", "since"))
    where = "" if host == socket.gethostname() else f" on {host}"
    if _is_gone(holder):
        return f"by processes that {command} has started, which was killed{where}"
    return f"by {command} (process {holder['pid']}{where}, since {since.replace('T', ' ')[:19]})"
