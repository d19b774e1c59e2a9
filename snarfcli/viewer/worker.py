"""Background thread for slow requests. It has no queue, so that outdated requests never delay the newest one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

__all__ = ["BackgroundWorker"]


class BackgroundWorker:
    """A thread that runs one request at a time.

    A request to a busy worker is rejected. The caller repeats it when the worker is idle, as it is then.

    Args:
        work: computes the result of a request; may raise.
        done: called from the thread when a request has finished.
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

    def start(self, request: Any) -> bool:
        """Start a request; return False, and reject it, if the worker is busy."""
        with self._changed:
            if self._request is not None or self._outcome is not None or self._is_stopped:
                return False
            self._request = request
            self._changed.notify_all()
            return True

    def take(self) -> tuple[Any, Any, BaseException | None] | None:
        """Return the last request with its result and its exception, once; None if there is no new outcome."""
        with self._changed:
            outcome, self._outcome = self._outcome, None
            return outcome

    def stop(self, patience_s: float = 60.0) -> None:
        """Accept no more requests, and wait for the running one: the process would abort if it exited during native code."""
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
            except Exception as raised:  # the page shows any error, and the viewer continues
                error = raised
            with self._changed:
                self._request, self._outcome = None, (request, result, error)
            self._done()
