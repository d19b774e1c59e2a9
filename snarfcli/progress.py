"""Progress of long work: a bar on a terminal, one line now and then in a log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

__all__ = ["progress"]

log = logging.getLogger(__name__)
_Item = TypeVar("_Item")
_LOG_EVERY_S = 20.0


def progress(items: Iterable[_Item], *, total: int | None = None, desc: str, unit: str = "it") -> Iterator[_Item]:
    """Yield `items` and report how far it is: tqdm on a terminal, else a line every 20 seconds.

    Args:
        total: number of items, if `items` has no length.
        desc: what is being done, such as "preprocess 50002".
    """
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
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
