"""Requests to end: Ctrl-C, and the signals of job schedulers, containers and closed terminals, which do the same."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

__all__ = ["SIGNALS", "Noted", "Terminated", "exit_code", "interrupts_held_back", "interrupts_noted", "signals_as_interrupts"]

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals that ask the program to end."""


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP has asked the program to end; it ends as after Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def exit_code(interrupt: KeyboardInterrupt) -> int:
    """Return the exit code after an interrupt, as shells number it: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
    return 128 + (interrupt.number if isinstance(interrupt, Terminated) else signal.SIGINT)


@contextlib.contextmanager
def signals_as_interrupts() -> Iterator[None]:
    """Raise `Terminated` on SIGTERM and SIGHUP, once: a closed terminal sends several, which must not stop the cleaning up.

    Signals that this process ignores, as with nohup, stay ignored.
    """
    is_raised = threading.Event()

    def handle(number: int, frame: Any) -> None:
        if not is_raised.is_set():
            is_raised.set()
            raise Terminated(number)

    with _handled(handle, SIGNALS[1:]):
        yield


class Noted:
    """The request to end that has come, if any."""

    def __init__(self) -> None:
        self.number: int | None = None
        """Number of the signal."""
        self.raises = False
        """Whether a request raises at once."""

    def __bool__(self) -> bool:
        return self.number is not None

    def as_error(self) -> KeyboardInterrupt:
        """Return the exception for the request."""
        return KeyboardInterrupt() if self.number in (None, signal.SIGINT) else Terminated(self.number)

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Let requests raise at once while the block runs, for work that need not be finished."""
        self.raises = True
        try:
            yield
        finally:
            self.raises = False


@contextlib.contextmanager
def interrupts_noted(on_first: Callable[[], None]) -> Iterator[Noted]:
    """Yield what notes the first request to end, so that the block can end in a good place; a second Ctrl-C raises at once.

    Args:
        on_first: called at the first request.
    """
    noted = Noted()

    def handle(number: int, frame: Any) -> None:
        if noted.number == number == signal.SIGINT:
            raise KeyboardInterrupt
        if not noted:
            noted.number = number
            if noted.raises:
                raise noted.as_error()
            on_first()

    with _handled(handle, SIGNALS):
        yield noted


@contextlib.contextmanager
def _handled(handle: Callable[[int, Any], None], numbers: tuple[int, ...]) -> Iterator[None]:
    """Handle signals in the main thread, the only one that gets them.

    Signals that are ignored stay so, and those that native code handles, whose handlers Python could not bring back.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in numbers}
        before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Block the signals while processes are started: these never get them, and this process gets them afterwards.

    Started processes inherit the block. So a Ctrl-C, which reaches the whole group, or the SIGTERM of a job scheduler is left
    to this process, which ends the others.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
