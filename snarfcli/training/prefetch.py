"""Results made ahead of time by worker processes, and taken in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from snarfcli.parallel import Worker, interrupts_held_back

__all__ = ["Prefetch"]


class Prefetch:
    """Results number k, k + 1, k + 2 and so on of a function, made by worker processes while the caller does something else.

    DESIGN. Of W processes each makes every W-th result and sends it through a pipe of its own, so results are taken in
    order without a queue to sort them. A process that is ahead waits in the pipe until it is asked: at most one large
    result, or 64 kB of small ones, is waiting in each, and nothing else bounds memory. When the caller dies, sending fails
    and the processes end.

    Args:
        function: module-level generator function `function(*arguments, first, stride)` that yields the results of numbers
            `first`, `first + stride` and so on without end. A number must give the same result in any process.
        arguments: picklable.
        workers: number of processes, at least 1.
        fewer: how the user asks for fewer workers.
    """

    def __init__(self, function: Callable[..., Iterator[Any]], arguments: tuple[Any, ...], workers: int, fewer: str) -> None:
        self._function, self._arguments, self._count, self._fewer = function, arguments, workers, fewer
        self._workers: list[Worker] = []
        self._first = self._next = 0

    def get(self, number: int) -> Any:
        """Return the result of one number; the processes start anew unless it follows the last one that was asked for.

        Raises:
            UserError: a process ended without a word.
            Exception: whatever the function raised. No process is left then.
        """
        try:
            if not self._workers or number != self._next:
                self._start(number)
            _, result = self._workers[(number - self._first) % self._count].receive()
        except BaseException:
            self.close()
            raise
        self._next = number + 1
        return result

    def _start(self, number: int) -> None:
        self.close()
        self._first = number
        for worker in range(self._count):
            with interrupts_held_back():
                task = (*self._arguments, number + worker, self._count)
                self._workers.append(Worker(self._function, task, self._fewer))

    def close(self) -> None:
        """End all processes; harmless when there are none."""
        while self._workers:
            self._workers[-1].end()
            self._workers.pop()
