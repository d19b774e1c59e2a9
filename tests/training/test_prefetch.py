"""Results made ahead of time: order, failures, and no process left."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator

import pytest

from snarfcli.errors import UserError
from snarfcli.training.prefetch import Prefetch


def _count(fail_at: int, first: int, stride: int) -> Iterator[int]:
    for number in range(first, 10**9, stride):
        if number == fail_at:
            os._exit(9)
        yield number


def test_results_come_in_order_and_a_lost_process_is_reported() -> None:
    ahead = Prefetch(_count, (7,), 3, "training.workers=1")
    assert [ahead.get(number) for number in range(1, 7)] == [1, 2, 3, 4, 5, 6]
    with pytest.raises(UserError, match=r"worker process ended early \(exit code 9\).*training.workers=1"):
        ahead.get(7)
    assert not multiprocessing.active_children()
    assert ahead.get(8) == 8  # and goes on where that is wanted
    ahead.close()
    ahead.close()


def _fail(first: int, stride: int) -> Iterator[int]:
    yield first
    raise UserError("no such thing")


def test_a_failure_reaches_the_caller() -> None:
    ahead = Prefetch(_fail, (), 2, "training.workers=1")
    assert [ahead.get(0), ahead.get(1)] == [0, 1]
    with pytest.raises(UserError, match="no such thing"):
        ahead.get(2)
    assert not multiprocessing.active_children()
