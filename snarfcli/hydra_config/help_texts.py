"""Hydra's argument parser on Python 3.14, whose argparse checks help texts."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["lazy_help_texts"]


@contextmanager
def lazy_help_texts() -> Iterator[None]:
    """Let argparse accept help texts that are not strings, as before Python 3.14; it still checks those that are.

    Hydra 1.3 has one that is made only when it is shown. Python 3.14 raises ValueError for it.
    """
    owner: Any = argparse._ActionsContainer  # where Python 3.14 has it; older versions have none
    check = getattr(owner, "_check_help", None)
    if check is None:
        yield
        return

    def check_strings(container: Any, action: argparse.Action) -> None:
        if isinstance(action.help, str):
            check(container, action)

    owner._check_help = check_strings
    try:
        yield
    finally:
        owner._check_help = check
