"""Progress of long tasks: a bar on a terminal, one line every 20 seconds in a log; or several lines that are replaced."""

from __future__ import annotations

import contextlib
import logging
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence, Sized
from importlib.util import find_spec
from typing import Any, TypeVar

from snarfcli.texts import one_line, terminal_text

__all__ = ["ProgressLines", "progress", "progress_bar"]

log = logging.getLogger(__name__)
_Item = TypeVar("_Item")
_LOG_EVERY_S = 20.0
_LONGEST_NAME = 80
_REDRAW_EVERY_S = 1.0
_LOG_LINES_EVERY_S = 60.0


def progress(items: Iterable[_Item], *, total: int | None = None, desc: str, unit: str = "it") -> Iterator[_Item]:
    """Yield `items` and report the progress: tqdm on a terminal, otherwise one line every 20 seconds.

    Args:
        items: any items.
        total: number of items, if `items` has no length.
        desc: name of the task, such as "preprocess 50002".
        unit: name of one item.
    """
    desc = one_line(desc, _LONGEST_NAME)  # names of motions and subjects come from files
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(total=total, desc=desc, unit=unit) as bar:
        start = last = time.monotonic()
        for count, item in enumerate(items, 1):
            yield item
            now = time.monotonic()
            if bar is not None:
                bar.update(1)
            elif now - last >= _LOG_EVERY_S:
                last = now
                of_total = f" of {total}" if total else ""
                log.info("%s: %d%s %s, %s", desc, count, of_total, unit, _speed(count / (now - start), unit))


@contextlib.contextmanager
def progress_bar(*, total: int | None, done: int = 0, desc: str, unit: str) -> Iterator[Any]:
    """Yield a bar of tqdm on a terminal, else None, also if tqdm is not installed; see `progress`.

    Args:
        done: number of items that were done before.
    """
    if not _has_bars():
        yield None
        return
    from tqdm import tqdm

    with tqdm(file=_Terminal(), total=total, initial=done, desc=desc, unit=unit, dynamic_ncols=True) as bar:
        yield bar


def _speed(per_s: float, unit: str) -> str:
    return f"{per_s:.1f} {unit}/s" if per_s >= 1 else f"{1 / per_s:.1f} s each"


class ProgressLines:
    """Lines about work with several parts: replaced every second on a terminal, logged once a minute otherwise."""

    def __init__(self) -> None:
        self._is_drawn = _has_bars()
        self._bars: list[Any] = []  # of tqdm
        self._shown_at: float | None = None if self._is_drawn else time.monotonic()

    def is_due(self) -> bool:
        """Return whether it is time for `show`."""
        every_s = _REDRAW_EVERY_S if self._is_drawn else _LOG_LINES_EVERY_S
        return self._shown_at is None or time.monotonic() - self._shown_at >= every_s

    def show(self, lines: Sequence[str]) -> None:
        """Show lines, in place of those before."""
        self._shown_at = time.monotonic()
        if not self._is_drawn:
            log.info("%s", "\n".join(lines))
            return
        from tqdm import tqdm

        width = shutil.get_terminal_size().columns - 1  # a longer line would break
        while len(self._bars) < len(lines):
            self._bars.append(tqdm(file=_Terminal(), position=len(self._bars), bar_format="{desc}", leave=False))
        for index, bar in enumerate(self._bars):
            bar.set_description_str(terminal_text(lines[index])[:width] if index < len(lines) else "")

    def hide(self) -> None:
        """Remove the lines from the terminal before something else is printed; they come back with the next `show`."""
        for bar in self._bars:
            bar.clear()
        self._shown_at = None if self._is_drawn else self._shown_at

    def close(self) -> None:
        """Remove the lines for good."""
        for bar in reversed(self._bars):
            bar.close()
        self._bars = []


def _has_bars() -> bool:
    """Return whether standard error is a terminal, and tqdm is installed to draw on it."""
    return sys.stderr is not None and sys.stderr.isatty() and find_spec("tqdm") is not None


class _Terminal:
    """Standard error, silent after its terminal is closed: the work, or the checkpoint, must not fail for a bar."""

    def write(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.write(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)
