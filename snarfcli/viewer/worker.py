"""One thread for what takes long; it has no queue, so that nothing old is ever waited for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

__all__ = ["BackgroundWorker"]


class BackgroundWorker:
    """Does one thing at a time, in a thread of its own.

    Whoever wants something done asks again when the worker is idle, for what is wanted then: there are no old requests.

    Args:
        work: what is done with a request; may raise.
        done: told when the worker is idle again, from its thread.
    """

    def __init__(self, work: Callable[[Any], Any], done: Callable[[], None]) -> None:
        self._work = work
        self._done = done
        self._changed = threading.Condition()
        self._request: Any = None
        self._outcome: tuple[Any, Any, BaseException | None] | None = None
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run, name="snarf-view-worker", daemon=True)
        self._thread.start()

    @property
    def is_idle(self) -> bool:
        """Whether `start` would be heard: nothing is being done, and the last outcome was taken."""
        with self._changed:
            return self._request is None and self._outcome is None

    def start(self, request: Any) -> bool:
        """Begin with a request; False if the worker is busy, and then it is forgotten."""
        with self._changed:
            if self._request is not None or self._outcome is not None or self._is_stopped:
                return False
            self._request = request
            self._changed.notify_all()
            return True

    def take(self) -> tuple[Any, Any, BaseException | None] | None:
        """Return the request that was done last, its result and the error it raised; None if there is nothing new."""
        with self._changed:
            outcome, self._outcome = self._outcome, None
            return outcome

    def stop(self, patience_s: float = 60.0) -> None:
        """Take no more requests, and wait for what is being done: a process that ends in the middle of it aborts."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()
        self._thread.join(timeout=patience_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_stopped or self._request is not None)
                if self._is_stopped:
                    return
                request = self._request
            result, error = None, None
            try:
                result = self._work(request)
            except Exception as raised:  # whatever it is, the page shows it and goes on
                error = raised
            with self._changed:
                self._request, self._outcome = None, (request, result, error)
            self._done()
