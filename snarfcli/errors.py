"""The one error type for what a user can cause, and help with misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["UserError", "nearest"]


class UserError(ValueError):
    """Something a user can mend: one line that says what was wanted, what came and what to do next.

    The command line prints it without a stack trace and ends with exit code 2.
    """


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"` for the valid name closest to `name`, or an empty string where none is close."""
    match = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.5)
    return f"; did you mean {match[0][:60]!r}?" if match else ""  # names from files may hold anything
