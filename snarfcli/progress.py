"""Progress of long tasks: a bar on a terminal, one line every 20 seconds in a log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from snarfcli.texts import one_line

__all__ = ["progress"]

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
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(items, total=total, desc=desc, unit=unit, dynamic_ncols=True)
        return
    start = last = time.monotonic()
    for count, item in enumerate(items, 1):
        yield item
        now = time.monotonic()
        if now - last >= _LOG_EVERY_S:
            last = now
            of_total = f" of {total}" if total else ""
            log.info("%s: %d%s %s, %.1f %s/s", desc, count, of_total, unit, count / (now - start), unit)
