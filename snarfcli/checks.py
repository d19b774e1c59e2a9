"""Checks of settings before any work starts, with one kind of message for all commands."""

from __future__ import annotations

import math
from collections.abc import Iterable

from snarfcli.errors import UserError, nearest

__all__ = ["check_choice", "check_number"]


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Refuse a word that is none of `choices`, with the nearest one.

    Raises:
        UserError: it is none.
    """
    choices = tuple(choices)
    if value not in choices:
        raise UserError(f"{name} must be {' or '.join(choices)}, got '{value}'{nearest(value, choices)}")


def check_number(name: str, value: float | None, least: float, most: float | None = None) -> None:
    """Refuse a number below `least` or above `most`, and one that is not finite; None, for an option left out, passes.

    Raises:
        UserError: it is out of range.
    """
    if value is None:
        return
    if most is None:
        if not (value >= least and math.isfinite(value)):
            raise UserError(f"{name} must be at least {least}, got {value}")
    elif not least <= value <= most:
        raise UserError(f"{name} must be between {least} and {most}, got {value}")
