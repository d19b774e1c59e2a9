"""The error type for user errors, and helpers for its messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["UserError", "nearest"]


class UserError(ValueError):
    """An error that the user can fix. The message is one line: what was wanted, what was given, and what to do next.

    The command line prints it without a stack trace and exits with code 2.
    """


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"` with the valid name closest to `name`, or an empty string if none is similar."""
    match = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.5)
    return f"; did you mean {match[0][:60]!r}?" if match else ""  # names read from files can contain any character
