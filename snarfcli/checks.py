"""Checks of settings before any work starts, with one kind of message for all commands."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from snarfcli.errors import UserError, nearest

if TYPE_CHECKING:
    from snarfcli.deformer import SearchConfig

__all__ = ["check_choice", "check_number", "check_search"]

_SEARCHES = ("complete", "broyden")
_JACOBIANS = ("exact", "broyden")


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


def check_search(search: SearchConfig) -> None:
    """Refuse settings of the correspondence search that do not fit together; bones are checked where their number is known.

    Raises:
        UserError: one does not fit.
    """
    check_choice("search.name", search.name, _SEARCHES)
    check_choice("search.jacobian", search.jacobian, _JACOBIANS)
    if search.name == "complete" and search.init_bones is not None:
        raise UserError("search.init_bones is for search=broyden; the complete search has no start bones")
    if search.name == "complete" and search.jacobian != "exact":
        raise UserError("search.jacobian=broyden is for search=broyden; the complete search has the exact one at hand")
    check_number("search.max_steps", search.max_steps, 1)
    for name, value in (("tolerance", search.tolerance), ("divergence", search.divergence)):
        if not 0 < value < math.inf:
            raise UserError(f"search.{name} must be positive, got {value}")
