"""Work on several processes: how many, one worker process, and tasks that each run in a fresh one.

DESIGN. MeshLab's random state cannot be set, but it is the same at every start: a fresh process for each task makes the
samples a function of the task alone, for any number of workers. Starting one takes about 0.4 s, so tasks should last
seconds. Processes are spawned, not forked (threads, Windows), and send their results item by item through a pipe.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.interrupts import SIGNALS, interrupts_held_back
from snarfcli.locks import inherited_locks
from snarfcli.safe_start import safe_imports

__all__ = ["Worker", "choose_processes", "count_cores", "end_workers", "parse_processes", "run_in_processes"]

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")
_MOST_PROCESSES = 64
_START_METHODS = ("fork", "forkserver", "spawn")


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parse_processes(text: str) -> int | None:
    """Return the number of processes in a setting, None for auto.

    Raises:
        UserError: it is neither auto nor a number in range.
    """
    word = str(text).strip().lower()
    if word == "auto":
        return None
    if not (word.isdecimal() and 1 <= int(word) <= _MOST_PROCESSES):
        raise UserError(f"processes: wanted auto or a number from 1 to {_MOST_PROCESSES}, got '{text}'")
    return int(word)


def choose_processes(tasks: int, bytes_each: int, least_tasks: int = 1) -> int:
    """Return the number of processes to use: one per core, as far as free memory and tasks allow.

    Args:
        tasks: number of tasks.
        bytes_each: memory of one process, bytes.
        least_tasks: minimum number of tasks that is worth the start of a process.
    """
    return max(1, min(count_cores(), _free_bytes() // bytes_each, tasks // least_tasks, _MOST_PROCESSES))


def _free_bytes() -> int:
    """Return the available memory, bytes; a very large number where the system does not report it."""
    facts = Path("/proc/meminfo")
    if facts.is_file():
        for line in facts.read_text(errors="replace").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    return 2**50


class Worker:
    """A fresh single-threaded process that runs a generator function and sends each item that it yields.

    The process ignores the signals that ask the whole group to end; the parent process ends it. It also ends when the parent
    is killed, and until then keeps the locks that the parent held (see `locks`). When it is ahead of the receiver, it waits
    as soon as the pipe is full (0.2 MB on Linux).
    """

    def __init__(
        self,
        function: Callable[..., Iterable[Any]],
        task: tuple[Any, ...],
        fewer: str = "workers=1",
        *,
        has_requests: bool = False,
    ) -> None:
        """Start `function(*task)`; wrap it and the line that stores the worker in `interrupts_held_back`.

        Args:
            function: a module-level generator function; its items must be picklable.
            task: its arguments, picklable.
            fewer: the setting that asks for fewer workers, for the message when memory runs out.
            has_requests: whether the function gets one more argument, an iterator over what is passed to `send`.

        Raises:
            UserError: the process has ended at once, for example because the system killed it when memory ran out.
        """
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        work = pickle.dumps((function, task))  # here, so that a failure to read it there is reported like any other
        self._process = context.Process(target=_serve, args=(theirs, has_requests, _Locks()), daemon=True)
        self._fewer = fewer
        with _one_thread(), _standard_start_method(), safe_imports():
            self._process.start()
        theirs.close()
        try:  # not among the arguments: `start` would wait for ever for a process that has ended before it has read them
            self.connection.send_bytes(work)
        except OSError:
            raise self._lost() from None

    def send(self, request: Any) -> None:
        """Send a request to a function that takes requests.

        Raises:
            UserError: the process has ended early, for example because the system killed it when memory ran out.
            Exception: the exception that the function raised.
        """
        try:
            self.connection.send(request)
        except OSError:
            while self.receive()[0]:  # raises the reason if there is one
                pass
            raise self._lost() from None

    def receive(self) -> tuple[bool, Any]:
        """Wait for the next item and return (True, item), or (False, None) after the last one.

        Raises:
            UserError: the process has ended early, for example because the system killed it when memory ran out.
            Exception: the exception that the function raised.
        """
        try:
            kind, item = self.connection.recv()
        except (EOFError, OSError):  # before a message, or in the middle of one
            raise self._lost() from None
        if kind == "error":
            raise item
        return kind == "item", item

    def end(self) -> None:
        """End the process, also in the middle of its work, and wait until it has ended.

        A file that it was writing stays under its temporary name; the caller deletes it.
        """
        self.connection.close()
        self._process.kill()
        self._process.join()

    def _lost(self) -> UserError:
        self._process.join()
        return UserError(
            f"a worker process ended early (exit code {self._process.exitcode}); "
            f"if memory ran out, try again with fewer workers, for example {self._fewer}"
        )


def end_workers(workers: Sequence[Worker]) -> None:
    """End several workers at the same time."""
    threads = [threading.Thread(target=worker.end) for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def run_in_processes(
    function: Callable[..., Iterable[Any]], tasks: Iterable[tuple[Any, ...]], workers: int
) -> Generator[tuple[int, Any], None, None]:
    """Run `function(*task)` for every task, each in a fresh single-threaded process, and yield what it yields.

    Args:
        function: a module-level generator function; its items and the tasks must be picklable.
        tasks: argument tuples, drawn one at a time when a process is free.
        workers: number of processes at a time.

    Yields:
        (number of the task, item): the items of a task in order, those of different tasks interleaved.

    Raises:
        UserError: a process ended early, for example because the system killed it when memory ran out.
        Exception: an exception of `function`. All processes have ended when any exception leaves this function,
            KeyboardInterrupt included.
    """
    running: dict[Any, tuple[int, Worker]] = {}  # by connection
    numbered = enumerate(tasks)
    exhausted = False
    try:
        while True:
            while not exhausted and len(running) < max(1, workers):
                number, task = next(numbered, (-1, ()))
                if number < 0:
                    exhausted = True
                    break
                with interrupts_held_back():
                    worker = Worker(function, task)
                    running[worker.connection] = number, worker
            if not running:
                return
            for connection in wait(list(running)):
                number, worker = running[connection]
                has_item, item = worker.receive()
                if has_item:
                    yield number, item
                else:
                    worker.end()
                    del running[connection]
    finally:
        for _, worker in running.values():
            worker.end()


class _Locks:
    """The locks of the parent, which a worker keeps open by receiving them: they are free only when both have ended."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _Locks.kept, ([reduction.DupFd(descriptor) for descriptor in inherited_locks()],)

    @staticmethod
    def kept(sent: Sequence[Any]) -> list[int]:
        """Take over the descriptors in the worker."""
        return [descriptor.detach() for descriptor in sent]


def _serve(connection: Connection, has_requests: bool, locks: Any) -> None:
    """Run one task in the worker and send each item; the parent decides what a failure means."""
    for number in SIGNALS:  # they reach the whole group; the parent ends the workers
        with contextlib.suppress(ValueError):
            signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        function, task = pickle.loads(connection.recv_bytes())
        for item in function(*task, *([_requests(connection)] if has_requests else [])):
            connection.send(("item", item))
        connection.send(("done", None))
    except (BrokenPipeError, ConnectionResetError):
        pass  # the parent has closed the connection: the rest is not needed
    except Exception as error:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            try:
                connection.send(("error", error))
            except (TypeError, AttributeError, pickle.PicklingError):
                connection.send(("error", RuntimeError(f"{type(error).__name__}: {error}")))
    finally:
        connection.close()


def _end_with_parent() -> None:
    """End this process when its parent has ended, also without a word; it must not go on writing files then."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _requests(connection: Connection) -> Iterator[Any]:
    """Yield what the parent sends until it closes the connection."""
    while True:
        try:
            request = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        yield request


@contextlib.contextmanager
def _standard_start_method() -> Iterator[None]:
    """Start processes that know the start method of this one: joblib's own processes have one that others do not know."""
    before = multiprocessing.get_start_method(allow_none=True)
    if before in (None, *_START_METHODS):
        yield
        return
    multiprocessing.set_start_method("spawn", force=True)
    try:
        yield
    finally:
        multiprocessing.set_start_method(before, force=True)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Start processes whose numerical libraries use one thread each; several processes share the cores already."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
