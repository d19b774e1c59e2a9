"""Checks of settings before any work starts, with one form of message: `name: wanted X, got Y`."""

from __future__ import annotations

import math
from collections.abc import Iterable

from snarfcli.errors import UserError, nearest

__all__ = ["alternatives", "check_choice", "check_number", "check_positive"]


def alternatives(choices: Iterable[str]) -> str:
    """Return choices as text: `a, b or c`."""
    *others, last = choices
    return f"{', '.join(others)} or {last}" if others else last


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Check that a setting has one of the values `choices`.

    Raises:
        UserError: it has another value; the message suggests the most similar choice.
    """
    choices = tuple(choices)
    if value not in choices:
        raise UserError(f"{name}: wanted {alternatives(choices)}, got '{value}'{nearest(value, choices)}")


def check_number(name: str, value: float | None, least: float, most: float | None = None) -> None:
    """Check that a number is finite and within `least` and `most`, inclusive. None (a setting that is not given) passes.

    Raises:
        UserError: the number is out of range.
    """
    if value is None:
        return
    if most is None:
        if not (value >= least and math.isfinite(value)):
            raise UserError(f"{name}: wanted at least {least}, got {value}")
    elif not least <= value <= most:
        raise UserError(f"{name}: wanted {least} to {most}, got {value}")


def check_positive(name: str, value: float | None) -> None:
    """Check that a number is finite and greater than 0. None (a setting that is not given) passes.

    Raises:
        UserError: it is not.
    """
    if value is not None and not 0 < value < math.inf:
        raise UserError(f"{name}: wanted a positive number, got {value}")
