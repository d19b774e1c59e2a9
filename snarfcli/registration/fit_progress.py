"""How far the fit of a sequence is, in frames, while all of them are worked on several times."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["FrameProgress"]


class FrameProgress:
    """Spreads the numbers of the frames evenly over the work that a sequence is expected to take.

    Args:
        frames: of the sequence.
        work: that is expected in all, in any unit.
        last: work of the last stage, which is known exactly; what comes before it never takes its share.
        tell: is called with each number from 0 to `frames` - 1 once, in order; None: there is no progress to report.
    """

    def __init__(self, frames: int, work: float, last: float, tell: Callable[[int], None] | None) -> None:
        self._frames, self._work, self._tell = frames, work, tell
        self._before_last = work - last
        self._limit, self._done, self._told = self._before_last, 0.0, 0

    def add(self, work: float) -> None:
        """Count work that is done."""
        self._done = min(self._done + work, self._limit)
        self._tell_until(int(self._frames * self._done / self._work))

    def start_last(self) -> None:
        """Begin the last stage; what was expected before it is over."""
        self._done, self._limit = self._before_last, self._work
        self.add(0)

    def finish(self) -> None:
        """Tell the numbers that are left."""
        self._tell_until(self._frames)

    def _tell_until(self, count: int) -> None:
        while self._told < count:
            self._told += 1
            if self._tell is not None:
                self._tell(self._told - 1)
