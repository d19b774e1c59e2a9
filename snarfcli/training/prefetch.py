"""Results made ahead of time by worker processes and received in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from snarfcli.interrupts import interrupts_held_back
from snarfcli.parallel import Worker

__all__ = ["Prefetch"]


class Prefetch:
    """Results number k, k + 1, k + 2 and so on of a function, made by worker processes while the caller continues.

    DESIGN. Each of W processes makes every W-th result and sends it through its pipe, so results are received in order without
    a sorting queue. A process that is ahead blocks on its pipe: at most one large result, or 0.2 MB of small ones, waits in
    each, which is the only bound on memory. When the caller dies, sending fails and the processes end.

    Args:
        function: module-level generator function `function(*arguments, first, stride)` that yields the results of numbers
            `first`, `first + stride` and so on without end. A number must give the same result in any process.
        arguments: of the function, picklable.
        workers: number of processes, at least 1.
        fewer: setting that reduces the number of workers, for messages.
    """

    def __init__(self, function: Callable[..., Iterator[Any]], arguments: tuple[Any, ...], workers: int, fewer: str) -> None:
        self._function, self._arguments, self._count, self._fewer = function, arguments, workers, fewer
        self._workers: list[Worker] = []
        self._first = self._next = 0

    def get(self, number: int) -> Any:
        """Return the result of one number; the processes restart unless it follows the previous one.

        Raises:
            UserError: a process was killed, for example by the out-of-memory killer.
            Exception: the function raised it. All processes have ended then.
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
        """End all processes, if there are any."""
        while self._workers:
            self._workers[-1].end()
            self._workers.pop()
