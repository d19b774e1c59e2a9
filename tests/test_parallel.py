"""Work in several processes: order, errors, and that no process is left running."""

from __future__ import annotations

import multiprocessing
import multiprocessing.spawn
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from snarfcli.errors import UserError
from snarfcli.parallel import Worker, choose_processes, count_cores, end_workers, parse_processes, run_in_processes


def _count(start: int, stop: int) -> Iterator[tuple[int, int]]:
    for value in range(start, stop):
        yield value, os.getpid()


def _fail(kind: str) -> Iterator[int]:
    yield 1
    if kind == "die":
        os._exit(7)
    if kind == "strange":
        error = ValueError("cannot be sent")
        error.reason = lambda: None  # type: ignore[attr-defined]
        raise error
    raise UserError("no such thing")


def _forever() -> Iterator[int]:
    while True:
        yield 0


def _answer(factor: int, requests: Iterator[int]) -> Iterator[int]:
    for request in requests:
        if request < 0:
            raise UserError("negative")
        yield factor * request


def _deaf() -> Iterator[bytes]:
    """Ignore the signal to end, as happens where Python ignores exceptions, and fill the pipe."""
    signal.signal(signal.SIGTERM, lambda *_: None)
    while True:
        yield bytes(1 << 20)


def test_a_process_that_is_deaf_to_signals_ends_too() -> None:
    worker = Worker(_deaf, ())
    assert worker.receive()[0]
    worker.end()
    assert not multiprocessing.active_children()


def test_every_task_has_its_own_process_and_keeps_its_order() -> None:
    items: dict[int, list] = {}
    for task, item in run_in_processes(_count, [(0, 3), (10, 10), (5, 7)], 2):
        items.setdefault(task, []).append(item)
    assert {task: [value for value, _ in found] for task, found in items.items()} == {0: [0, 1, 2], 2: [5, 6]}
    assert len({process for found in items.values() for _, process in found} | {os.getpid()}) == 3
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        ("raise", UserError, "no such thing"),
        ("die", UserError, r"worker process ended early \(exit code 7\).*fewer workers"),
        ("strange", RuntimeError, "ValueError: cannot be sent"),
    ],
)
def test_a_failure_reaches_the_caller(kind: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        list(run_in_processes(_fail, [(kind,)], 1))
    assert not multiprocessing.active_children()


class _Unreadable:
    def __reduce__(self):
        return _fail_to_load, ()


def _fail_to_load() -> None:
    raise UserError("cannot be read there")


def test_a_task_that_cannot_be_read_is_reported() -> None:
    with pytest.raises(UserError, match="cannot be read there"):
        list(run_in_processes(_count, [(_Unreadable(), 1)], 1))


@pytest.mark.skipif(os.name != "posix", reason="a script as the interpreter")
def test_a_process_that_ends_before_it_has_its_task_is_reported(tmp_path: Path) -> None:
    ends_at_once = tmp_path / "python"
    ends_at_once.write_text("#!/bin/sh\nexit 7\n")
    ends_at_once.chmod(0o700)
    before = multiprocessing.spawn.get_executable()
    multiprocessing.spawn.set_executable(str(ends_at_once))
    try:
        with pytest.raises(UserError, match=r"ended early \(exit code 7\)"):
            Worker(_large, (bytes(2**22),))
    finally:
        multiprocessing.spawn.set_executable(before)


def _large(content: bytes) -> Iterator[int]:
    """Take a task that is larger than a pipe."""
    yield len(content)


def test_leaving_early_ends_the_workers_and_draws_no_more_tasks() -> None:
    drawn = []

    def tasks() -> Iterator[tuple]:
        for number in range(100):
            drawn.append(number)
            yield ()

    results = run_in_processes(_forever, tasks(), 1)
    assert next(results) == (0, 0)
    results.close()
    assert not multiprocessing.active_children()
    assert drawn == [0]


def test_requests_are_answered_in_order_until_one_fails() -> None:
    worker = Worker(_answer, (3,), has_requests=True)
    for request in (1, 2):
        worker.send(request)
        assert worker.receive() == (True, 3 * request)
    worker.send(-1)
    with pytest.raises(UserError, match="negative"):
        worker.receive()
    worker.end()
    assert not multiprocessing.active_children()


def test_a_request_to_a_process_that_was_killed_is_reported() -> None:
    worker = Worker(_answer, (3,), "processes=2", has_requests=True)
    worker.send(1)
    assert worker.receive() == (True, 3)
    assert worker._process.pid is not None
    os.kill(worker._process.pid, signal.SIGKILL)
    worker._process.join()
    with pytest.raises(UserError, match=r"ended early \(exit code -9\).*fewer workers, for example processes=2"):
        worker.send(2)
    end_workers([worker])
    assert not multiprocessing.active_children()


def test_a_request_to_a_function_that_could_not_start_tells_why() -> None:
    worker = Worker(_answer, (_Unreadable(),), has_requests=True)
    worker._process.join()
    with pytest.raises(UserError, match="cannot be read there"):
        worker.send(2)
    worker.end()


def test_number_of_processes() -> None:
    assert parse_processes("auto") is None
    assert parse_processes("3") == 3
    for text in ("0", "-1", "many", "65", "1.5"):
        with pytest.raises(UserError, match="processes: wanted auto or a number from 1 to 64, got"):
            parse_processes(text)
    assert choose_processes(1000, 1) == min(count_cores(), 64)
    assert choose_processes(5, 1, least_tasks=6) == 1
    assert choose_processes(1000, 2**60) == 1


def _squares(value: int) -> Iterator[int]:
    yield value * value


def _in_processes(value: int) -> list[tuple[int, int]]:
    return list(run_in_processes(_squares, [(value,)], 1))


def test_processes_of_joblib_can_start_processes():
    joblib = pytest.importorskip("joblib")
    from joblib.externals.loky import get_reusable_executor

    try:
        found = joblib.Parallel(n_jobs=2)(joblib.delayed(_in_processes)(value) for value in (2, 3))
    finally:
        get_reusable_executor().shutdown()  # its processes would wait for other tests
    assert found == [[(0, 4)], [(0, 9)]]
