"""Reads broken files by the thousand: whatever bytes a file holds, a reader returns or raises one `UserError` of one line.

Each file is a seed of its target, broken in one to four places. Number `index` of seed `seed` is always the same file, so a
failure can be repeated alone: `broken_file(target, seed, index)`.
"""

from __future__ import annotations

import faulthandler
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fuzz_damage import DAMAGES

from snarfcli.errors import UserError

__all__ = ["Target", "broken_file", "check_target", "find_failures", "scratch_folder"]

MAX_SECONDS = 5.0
MAX_GROWTH = 2**30
MAX_MESSAGE = 1000
# A reader stuck inside native code hears no signal. This long after the start the process is ended with a stack trace.
_STUCK_SECONDS = 20.0


@dataclass(frozen=True)
class Target:
    """One reader and what it should be fed with."""

    name: str
    """For example `bvh`."""
    suffix: str
    """Of the files, for example `.bvh`."""
    seeds: Callable[[], list[bytes]]
    """Small files that the reader accepts (some hundred bytes to some kB), of several kinds."""
    read: Callable[[Path], object]
    """The public reader."""
    extra: Callable[[random.Random, bytes], bytes] | None = None
    """One more way of breaking a seed, which knows the format: wrong shapes, other types, cycles."""


class _TookTooLong(BaseException):
    """Not an Exception, so that no reader mistakes it for something wrong with its file."""


class _Forbidden(BaseException):
    """A reader began something that no file may cause."""


def check_target(target: Target, count: int, seed: int, folder: Path) -> None:
    """Read `count` broken files, and fail at the first that is not handled as it should be.

    Good is: the reader returns, or raises a `UserError` whose message is one printable line that holds the file's name. Either
    way within 5 s, with less than 1 GiB of memory, starting no program, connecting nowhere, and writing, moving or removing
    nothing.

    Args:
        target: the reader.
        count: files.
        seed: of the damage; the same seed makes the same files.
        folder: where the bytes of the failing file are kept.

    Raises:
        AssertionError: a file was not handled; the message says which, and where it was kept.
    """
    with scratch_folder() as scratch:
        for failure in find_failures(target, range(count), seed, folder, scratch):
            raise AssertionError(failure)


def find_failures(target: Target, indices: Iterable[int], seed: int, folder: Path, scratch: Path) -> Iterator[str]:
    """Read the broken files `indices` and yield a line (and a stack trace, where there is one) for each mishandled one.

    The file being read is `scratch/fuzz<suffix>` and its number is in `scratch/index`: so they can be found after a crash.
    """
    path = scratch / f"fuzz{target.suffix}"
    seeds = target.seeds()
    assert seeds, f"{target.name}: no seeds"
    for number, content in enumerate(seeds):
        path.write_bytes(content)
        failure, refused = _try(target, path, _peak_memory())
        if failure or refused:
            yield f"{target.name}: seed {number} must be a good file: {failure or refused}"
            return
    peak = _peak_memory()
    for index in indices:
        content = broken_file(target, seed, index, seeds)
        (scratch / "index").write_text(str(index))
        path.write_bytes(content)
        failure, _ = _try(target, path, peak)
        if failure:
            folder.mkdir(parents=True, exist_ok=True)
            kept = folder / f"{target.name}-{seed}-{index}{target.suffix}"
            kept.write_bytes(content)
            yield f"{target.name}: file {index} of seed {seed}, kept as {kept}: {failure}"
            peak = max(peak, _peak_memory() - MAX_GROWTH // 2)


def broken_file(target: Target, seed: int, index: int, seeds: list[bytes] | None = None) -> bytes:
    """Return file `index`: one of the seeds with one to four kinds of damage."""
    rng = random.Random(f"{target.name}/{seed}/{index}")
    seeds = target.seeds() if seeds is None else seeds
    content = rng.choice(seeds)
    if target.extra is not None and rng.random() < 0.4:
        content = target.extra(rng, content)
        if rng.random() < 0.6:
            return content
    for _ in range(rng.choice([1, 1, 1, 2, 2, 4])):
        content = rng.choice(DAMAGES)(rng, content, rng.choice(seeds))
    return content[: max(2**16, 4 * max(map(len, seeds)))]


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a new folder, in memory where the system has such a place, and remove it afterwards."""
    memory = Path("/dev/shm")
    parent = memory if memory.is_dir() and os.access(memory, os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="snarf-fuzz-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _try(target: Target, path: Path, peak: int) -> tuple[str, str]:
    """Read one file; return what is wrong with how that went, and the message if the file was refused."""
    refused, failure = "", ""
    start = time.monotonic()
    try:
        with _watched(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(path)
    except UserError as error:
        refused = str(error)
    except _TookTooLong:
        failure = f"took over {MAX_SECONDS:g} s\n{traceback.format_exc(limit=-8)}"
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:  # SystemExit and pytest's own too: a reader may raise nothing but UserError
        failure = f"{type(error).__name__}: {error}\n{traceback.format_exc(limit=-8)}"
    elapsed = time.monotonic() - start
    if not failure and elapsed > MAX_SECONDS:
        failure = f"took {elapsed:.1f} s, wanted at most {MAX_SECONDS:g}"
    if not failure and (growth := _peak_memory() - peak) > MAX_GROWTH:
        failure = f"took {growth / 2**30:.1f} GiB of memory, wanted at most 1"
    if not failure and refused:
        failure = _wrong_message(refused, path)
    return failure, refused


def _wrong_message(message: str, path: Path) -> str:
    if path.name not in message:
        return f"the message does not name the file: {message!r}"
    if not message.isprintable():  # line ends, terminal controls, lone surrogates: show what a file holds by its repr
        return f"the message is not one printable line: {message!r}"
    if len(message) - len(str(path)) > MAX_MESSAGE:
        return f"the message has {len(message)} characters: {message[:200]!r} ..."
    return ""


# --- watching a reader -------------------------------------------------------------------------------------------------------

_FORBIDDEN = (
    "os.system", "os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.startfile", "subprocess.Popen",
    "socket.connect", "socket.getaddrinfo", "socket.bind", "urllib.Request", "webbrowser.open", "os.remove", "os.rename",
    "os.rmdir", "os.mkdir", "os.symlink", "os.link", "os.truncate", "os.chmod", "shutil.rmtree", "os.putenv", "os.unsetenv",
)  # fmt: skip
_state = threading.local()
_is_hooked = False


@contextmanager
def _watched() -> Iterator[None]:
    """Limit the time of the block, and forbid what no file may cause."""
    global _is_hooked
    if not _is_hooked:  # hooks cannot be removed again
        sys.addaudithook(_audit)
        _is_hooked = True
    has_signal = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if has_signal:
        previous = signal.signal(signal.SIGALRM, _raise_took_too_long)
    try:
        faulthandler.dump_traceback_later(_STUCK_SECONDS, exit=True, file=sys.__stderr__)
        if has_signal:  # again and again, should something swallow the first one
            signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS, 1.0)
        _state.is_reading = True
        yield
    finally:
        _state.is_reading = False
        if has_signal:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, previous)
        faulthandler.cancel_dump_traceback_later()


def _raise_took_too_long(signum: int, frame: object) -> None:
    raise _TookTooLong


def _audit(event: str, arguments: tuple) -> None:
    if not getattr(_state, "is_reading", False):
        return
    if event in _FORBIDDEN:
        raise _Forbidden(f"{event} {arguments!r:.200}")
    # Python writes the byte code of a module when a reader first needs it.
    if event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+"):
        raise _Forbidden(f"open for writing: {arguments!r:.200}")


def _peak_memory() -> int:
    """Return the most memory that this process ever had, in bytes; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
