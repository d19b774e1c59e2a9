from __future__ import annotations

import threading

import pytest

from snarfcli.viewer.worker import BackgroundWorker

PATIENCE_S = 300  # only a broken test waits that long, however busy the machine is


@pytest.fixture
def idle() -> threading.Event:
    return threading.Event()


def test_one_thing_at_a_time_and_nothing_queued(idle):
    go_on, begun = threading.Event(), threading.Event()

    def work(number):
        begun.set()
        assert go_on.wait(PATIENCE_S)
        return 2 * number

    worker = BackgroundWorker(work, idle.set)
    assert worker.take() is None
    assert worker.start(1)
    assert begun.wait(PATIENCE_S)
    assert not worker.start(2)  # forgotten
    go_on.set()
    assert idle.wait(PATIENCE_S)
    assert not worker.start(3)  # not before the outcome is taken
    assert worker.take() == (1, 2, None)
    assert worker.take() is None
    idle.clear()
    assert worker.start(4)
    assert idle.wait(PATIENCE_S)
    assert worker.take() == (4, 8, None)
    worker.stop()
    assert not worker.start(5)


def test_an_error_is_handed_over(idle):
    def work(request):
        raise ValueError("no surface")

    worker = BackgroundWorker(work, idle.set)
    worker.start("it")
    assert idle.wait(PATIENCE_S)
    request, result, error = worker.take()
    assert (request, result, str(error)) == ("it", None, "no surface")
    worker.stop()
