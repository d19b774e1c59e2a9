"""Work on several processes, each task in a fresh one.

DESIGN. MeshLab's random state cannot be set, but it is the same at every start: a fresh process for each task makes the
samples a function of the task alone, whatever the number of workers. Starting one takes about 0.4 s, so tasks should last
seconds. Processes are spawned, not forked (threads, Windows), and send their results item by item through a pipe.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from typing import Any

from snarfcli.errors import UserError

__all__ = ["Worker", "count_cores", "interrupts_held_back", "run_in_processes"]

_PATIENCE_S = 10.0  # for a process that was told to end; writing a large mesh takes a second
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")


def count_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Worker:
    """A fresh single-threaded process that runs a generator function and sends what it yields, item by item.

    It pays no heed to Ctrl-C, which reaches the whole group: whoever started it ends it. When it gets ahead of the one who
    receives, it waits as soon as the pipe is full (64 kB on Linux).
    """

    def __init__(self, function: Callable[..., Iterable[Any]], task: tuple[Any, ...], fewer: str = "workers=1") -> None:
        """Start `function(*task)`; hold interrupts back meanwhile, and until the worker is where it will be ended from.

        Args:
            function: a module-level generator function; its items must be picklable.
            task: its arguments, picklable.
            fewer: how the user asks for fewer workers.
        """
        context = multiprocessing.get_context("spawn")
        self.receiver, sender = context.Pipe(duplex=False)
        work = pickle.dumps((function, task))  # here, so that a failure to read it there is reported like any other
        self._process = context.Process(target=_serve, args=(sender, work), daemon=True)
        self._fewer = fewer
        with _one_thread():
            self._process.start()
        sender.close()

    def receive(self) -> tuple[bool, Any]:
        """Wait for the next item and return (True, item), or (False, None) after the last one.

        Raises:
            UserError: the process ended without a word, as when the system kills it for want of memory.
            Exception: whatever the function raised.
        """
        try:
            kind, item = self.receiver.recv()
        except (EOFError, OSError):  # before a message, or in the middle of one
            self._process.join()
            raise UserError(
                f"a worker process ended early (exit code {self._process.exitcode}); "
                f"if memory ran out, try again with fewer workers, for example {self._fewer}"
            ) from None
        if kind == "error":
            raise item
        return kind == "item", item

    def end(self) -> None:
        """End the process, whatever it is doing; nothing is left of it afterwards."""
        self.receiver.close()  # first: a process that waits for somebody to receive goes on then, to its end
        self._process.terminate()
        self._process.join(_PATIENCE_S)
        if self._process.is_alive():  # Python heard the signal where it passes over exceptions, or hangs in native code
            self._process.kill()
            self._process.join()


def run_in_processes(
    function: Callable[..., Iterable[Any]], tasks: Iterable[tuple[Any, ...]], workers: int
) -> Iterator[tuple[int, Any]]:
    """Run `function(*task)` for every task, each in a fresh single-threaded process, and yield what it yields.

    Args:
        function: a module-level generator function; its items and the tasks must be picklable.
        tasks: argument tuples, drawn one at a time when a process is free.
        workers: how many processes run at a time.

    Yields:
        (number of the task, item): the items of one task in order, the tasks interleaved.

    Raises:
        UserError: a process ended without a result, as when the system kills it for want of memory.
        Exception: whatever `function` raised. All processes have ended when this, a KeyboardInterrupt or anything else
            leaves here.
    """
    running: dict[Connection, tuple[int, Worker]] = {}
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
                    running[worker.receiver] = number, worker
            if not running:
                return
            for receiver in wait(list(running)):
                number, worker = running[receiver]
                has_item, item = worker.receive()
                if has_item:
                    yield number, item
                else:
                    worker.end()
                    del running[receiver]
    finally:
        for _, worker in running.values():
            worker.end()


def _serve(sender: Connection, work: bytes) -> None:
    """Run one task in the worker and send each item; the parent alone decides what a failure means."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends the workers
    try:
        function, task = pickle.loads(work)
        for item in function(*task):
            sender.send(("item", item))
        sender.send(("done", None))
    except BrokenPipeError:
        pass  # the parent is gone, so nobody waits for the rest
    except Exception as error:
        with contextlib.suppress(BrokenPipeError):
            try:
                sender.send(("error", error))
            except (TypeError, AttributeError, pickle.PicklingError):
                sender.send(("error", RuntimeError(f"{type(error).__name__}: {error}")))
    finally:
        sender.close()


@contextlib.contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Let a process start with Ctrl-C blocked, so that an early one prints no trace; ours arrives when this ends."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let a process start with one thread for every numerical library; several processes share the cores already."""
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
