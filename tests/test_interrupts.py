"""Requests to end: by Ctrl-C, by job schedulers and containers, and by closed terminals."""

from __future__ import annotations

import signal

import pytest

from snarfcli.interrupts import Terminated, exit_code, interrupts_noted, signals_as_interrupts


@pytest.fixture(autouse=True)
def _usual_handlers():
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)}
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals_raise_once_as_ctrl_c_does(number: int, code: int) -> None:
    with signals_as_interrupts():
        with pytest.raises(KeyboardInterrupt) as interrupt:
            signal.raise_signal(number)
        signal.raise_signal(number)  # while the program cleans up
    assert exit_code(interrupt.value) == code
    assert exit_code(KeyboardInterrupt()) == 130
    assert signal.getsignal(number) is signal.SIG_DFL


def test_ignored_signals_stay_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    with signals_as_interrupts(), interrupts_noted(lambda: None) as noted:
        signal.raise_signal(signal.SIGHUP)
    assert not noted


def test_signals_that_native_code_handles_stay_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    handler = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with signals_as_interrupts():
        assert signal.signal(signal.SIGTERM, signal.SIG_DFL) is handler


def test_a_second_ctrl_c_raises_and_other_second_requests_do_not() -> None:
    told: list[int] = []
    with interrupts_noted(lambda: told.append(1)) as noted:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)  # a job scheduler, and the program that started this one
        assert noted
        assert isinstance(noted.as_error(), Terminated)
    with interrupts_noted(lambda: told.append(2)):
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert told == [1, 2]


def test_work_that_need_not_be_finished_is_left_at_once() -> None:
    with interrupts_noted(lambda: None) as noted, pytest.raises(Terminated), noted.at_once():
        signal.raise_signal(signal.SIGTERM)
