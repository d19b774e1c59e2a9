"""The error type for user errors, and helpers for its messages."""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable
from pathlib import Path

__all__ = ["LOST_DRIVE", "UserError", "is_out_of_memory", "nearest", "raise_system_error"]

_WRONG_PLACE = (None, errno.EINVAL, errno.EOVERFLOW)  # of a seek to where the content of a damaged file says

LOST_DRIVE = (
    errno.ESTALE, errno.EIO, errno.ETIMEDOUT, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENETUNREACH,
    errno.ENOTCONN,
)  # fmt: skip
"""What a network drive answers that cannot be reached, or has lost a file; it may be back later."""


class UserError(ValueError):
    """An error that the user can fix. The message is one line: what was wanted, what was given, and what to do next.

    The command line prints it without a stack trace and exits with code 2.
    """


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"` with the valid name closest to `name`, or an empty string if none is similar."""
    match = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.5)
    return f"; did you mean {match[0][:60]!r}?" if match else ""  # names read from files can contain any character


def raise_system_error(error: BaseException, path: str | Path) -> None:
    """Raise an error of the system again, such as no permission or no memory, with the name of the file that was read.

    For readers, before they say that the content of a file is damaged: advice to delete it would destroy good data.

    Args:
        error: raised while a file was read.
        path: the file.

    Raises:
        OSError, MemoryError: the error does not come from the content of the file.
    """
    if is_out_of_memory(error):
        raise MemoryError(f"not enough memory to read {path}; close other programs") from None
    if isinstance(error, OSError) and error.errno not in _WRONG_PLACE:
        error.filename = error.filename or str(path)
        raise error


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether there was not enough memory, of the processor or of a GPU; PyTorch's errors have no type of their own."""
    words = ("can't allocate memory", "out of memory")
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(word in str(error) for word in words))
