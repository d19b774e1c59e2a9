"""Progress of long tasks: a bar on a terminal, one line every 20 seconds in a log."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from importlib.util import find_spec
from typing import Any, TypeVar

from snarfcli.texts import one_line

__all__ = ["progress", "progress_bar"]

log = logging.getLogger(__name__)
_Item = TypeVar("_Item")
_LOG_EVERY_S = 20.0
_LONGEST_NAME = 80


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
                log.info("%s: %d%s %s, %.1f %s/s", desc, count, of_total, unit, count / (now - start), unit)


@contextlib.contextmanager
def progress_bar(*, total: int | None, done: int = 0, desc: str, unit: str) -> Iterator[Any]:
    """Yield a bar of tqdm on a terminal, else None, also if tqdm is not installed; see `progress`.

    Args:
        done: number of items that were done before.
    """
    if sys.stderr is None or not sys.stderr.isatty() or find_spec("tqdm") is None:
        yield None
        return
    from tqdm import tqdm

    with tqdm(file=_Terminal(), total=total, initial=done, desc=desc, unit=unit, dynamic_ncols=True) as bar:
        yield bar


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
