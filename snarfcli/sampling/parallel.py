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

__all__ = ["count_cores", "run_in_processes"]

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")


def count_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
    context = multiprocessing.get_context("spawn")
    running: dict[Connection, tuple[int, Any]] = {}
    numbered = enumerate(tasks)
    exhausted = False
    try:
        while True:
            while not exhausted and len(running) < max(1, workers):
                number, task = next(numbered, (-1, ()))
                if number < 0:
                    exhausted = True
                    break
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(target=_serve, args=(sender, function, task), daemon=True)
                with _interrupts_held_back(), _one_thread():
                    process.start()
                    running[receiver] = (number, process)
                sender.close()
            if not running:
                return
            for receiver in wait(list(running)):
                number, process = running[receiver]
                try:
                    kind, item = receiver.recv()
                except EOFError:
                    process.join()
                    raise UserError(
                        f"a worker process ended early (exit code {process.exitcode}); "
                        "if memory ran out, try again with fewer workers, for example workers=1"
                    ) from None
                if kind == "item":
                    yield number, item
                    continue
                process.join()
                del running[receiver]
                receiver.close()
                if kind == "error":
                    raise item
    finally:
        for _, process in running.values():
            process.terminate()
        for receiver, (_, process) in running.items():
            process.join()
            receiver.close()


def _serve(sender: Connection, function: Callable[..., Iterable[Any]], task: tuple[Any, ...]) -> None:
    """Run one task in the worker and send each item; the parent alone decides what a failure means."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends the workers
    try:
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
def _interrupts_held_back() -> Iterator[None]:
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
