"""Fuzzing of file readers: for any bytes, a reader returns or raises a `UserError` whose message is one line.

Each file is a seed file of its target, damaged in one to four places. File `index` of seed `seed` is always the same, so that
a failure can be repeated alone: `broken_file(target, seed, index)`.
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

__all__ = ["Target", "broken_file", "check_target", "find_failures", "peak_memory", "scratch_folder"]

MAX_CPU_SECONDS = 5.0  # processor time, which does not depend on how busy the machine is
MAX_GROWTH = 2**30
MAX_MESSAGE = 1000
# A reader that waits, or hangs in native code, is not interrupted by a signal: after this time the process ends with a stack
# trace. Wall time, so far above the limit that a busy machine does not reach it.
_STUCK_SECONDS = 600.0


@dataclass(frozen=True)
class Target:
    """A reader, and how its test files are made."""

    name: str
    """For example `bvh`."""
    suffix: str
    """File suffix, for example `.bvh`."""
    seeds: Callable[[], list[bytes]]
    """Return small files that the reader accepts (100 bytes to some kB), of several kinds."""
    read: Callable[[Path], object]
    """The public reader."""
    extra: Callable[[random.Random, bytes], bytes] | None = None
    """Damage a seed file with knowledge of its format: wrong shapes, other types, cycles."""
    extra_share: float = 0.4
    """Share of the files that `extra` damages. Other damage rarely gets beyond the checksums of an archive."""
    cost: int = 1
    """How many files of a fast reader take as long as one of this reader; so many fewer are read."""
    unpack: Callable[[bytes, Path], Path] | None = None
    """Write the files that the bytes stand for below a folder and return the path to read, for a reader of a folder. All damage
    is that of `extra` then."""


class _TookTooLong(BaseException):
    """The reader exceeded its time. Not an Exception, so that no reader takes it for an error in its file."""


class _Forbidden(BaseException):
    """The reader did something that no file may cause."""


def check_target(target: Target, count: int, seed: int, folder: Path) -> None:
    """Read `count` damaged files, and fail at the first that is mishandled.

    A file is handled if the reader returns, or raises a `UserError` whose message is one printable line with the file's name.
    It takes at most 5 s of processor time and 1 GiB of memory, starts no program, opens no connection, and writes, moves and
    removes no file.

    Args:
        target: the reader.
        count: number of files.
        seed: of the damage; the same seed makes the same files.
        folder: where the failing file is kept.

    Raises:
        AssertionError: a file was mishandled; the message says which, and where it is kept.
    """
    with scratch_folder() as scratch:
        for failure in find_failures(target, range(count), seed, folder, scratch):
            raise AssertionError(failure)


def find_failures(target: Target, indices: Iterable[int], seed: int, folder: Path, scratch: Path) -> Iterator[str]:
    """Read the damaged files `indices`; for each mishandled one, yield a line and, if there is one, a stack trace.

    The current file is `scratch/fuzz<suffix>` and its number is in `scratch/index`, so that both can be found after a crash.
    """
    path = scratch / f"fuzz{target.suffix}"
    seeds = target.seeds()
    assert seeds, f"{target.name}: no seeds"

    def put(content: bytes) -> Path:
        path.write_bytes(content)
        if target.unpack is None:
            return path
        shutil.rmtree(scratch / "fuzzed", ignore_errors=True)
        return target.unpack(content, scratch / "fuzzed")

    for number, content in enumerate(seeds):
        given = put(content)
        failure, message = _try(target, given, peak_memory())
        if failure or message:
            yield f"{target.name}: seed {number} must be a good file: {failure or message}"
            return
    peak = peak_memory()
    for index in indices:
        content = broken_file(target, seed, index, seeds)
        (scratch / "index").write_text(str(index))
        failure, _ = _try(target, put(content), peak)
        if failure:
            folder.mkdir(parents=True, exist_ok=True)
            kept = folder / f"{target.name}-{seed}-{index}{target.suffix}"
            kept.write_bytes(content)
            yield f"{target.name}: file {index} of seed {seed}, kept as {kept}: {failure}"
            peak = max(peak, peak_memory() - MAX_GROWTH // 2)


def broken_file(target: Target, seed: int, index: int, seeds: list[bytes] | None = None) -> bytes:
    """Return file `index`: a seed file with one to four kinds of damage."""
    rng = random.Random(f"{target.name}/{seed}/{index}")
    seeds = target.seeds() if seeds is None else seeds
    content = rng.choice(seeds)
    if target.extra is not None and (target.unpack is not None or rng.random() < target.extra_share):
        content = target.extra(rng, content)
        if target.unpack is not None or rng.random() < 0.2 + target.extra_share:
            return content
    for _ in range(rng.choice([1, 1, 1, 2, 2, 4])):
        content = rng.choice(DAMAGES)(rng, content, rng.choice(seeds))
    return content[: max(2**16, 4 * max(map(len, seeds)))]


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a new folder, in memory where the system allows it, and remove it afterwards."""
    memory = Path("/dev/shm")
    parent = memory if memory.is_dir() and os.access(memory, os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="snarf-fuzz-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _try(target: Target, path: Path, peak: int) -> tuple[str, str]:
    """Read one file; return what the reader did wrong, and the message of its `UserError`; both may be empty."""
    message, failure = "", ""
    start = time.process_time()
    try:
        with _watched(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(path)
    except UserError as error:
        message = str(error)
    except _TookTooLong:
        failure = f"took over {MAX_CPU_SECONDS:g} s\n{traceback.format_exc(limit=-8)}"
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:  # SystemExit and pytest's own too: a reader may raise nothing but UserError
        failure = f"{type(error).__name__}: {error}\n{traceback.format_exc(limit=-8)}"
    cpu_seconds = time.process_time() - start
    if not failure and cpu_seconds > MAX_CPU_SECONDS:
        failure = f"took {cpu_seconds:.1f} s, wanted at most {MAX_CPU_SECONDS:g}"
    if not failure and (growth := peak_memory() - peak) > MAX_GROWTH:
        failure = f"took {growth / 2**30:.1f} GiB of memory, wanted at most 1"
    if not failure and message:
        failure = _wrong_message(message, path)
    return failure, message


def _wrong_message(message: str, path: Path) -> str:
    if path.name not in message:
        return f"the message does not name the file: {message!r}"
    if not message.isprintable():  # line ends, terminal controls, lone surrogates: show the content of a file by its repr
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
    """Limit the processor time of the block, and forbid what no file may cause."""
    global _is_hooked
    if not _is_hooked:  # hooks cannot be removed again
        sys.addaudithook(_audit)
        _is_hooked = True
    has_signal = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGPROF, _raise_took_too_long) if has_signal else None
    try:
        faulthandler.dump_traceback_later(_STUCK_SECONDS, exit=True, file=sys.__stderr__)
        if has_signal:  # repeatedly, in case the reader swallows the first one
            signal.setitimer(signal.ITIMER_PROF, MAX_CPU_SECONDS, 1.0)
        _state.is_reading = True
        yield
    finally:
        _state.is_reading = False
        if has_signal:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, previous)
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


def peak_memory() -> int:
    """Return the peak memory of this process, bytes; 0 where the system does not report it."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
