"""What the commands print: control characters are made visible, since names in a message can come from any file."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import traceback
import warnings
from types import TracebackType

from snarfcli.texts import terminal_text

__all__ = [
    "TerminalFormatter",
    "abandon_output",
    "escape_what_cannot_be_shown",
    "output_failure",
    "print_error",
    "set_up_output",
]

_LONGEST = 20_000  # characters of one log record; the longest table has 3,000


class TerminalFormatter(logging.Formatter):
    """Formats log records for a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return terminal_text(text if len(text) <= _LONGEST else f"{text[:_LONGEST]}...")


def escape_what_cannot_be_shown() -> None:
    """Let standard output and error show characters that their encoding lacks as escapes, as on Windows' older code pages.

    Otherwise printing them is an error, and a name in another alphabet would end a command or lose a line.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def set_up_output() -> None:
    """Print the program's own messages on standard output, without time or level; make other output safe to show too."""
    handler = _Handler(sys.stdout)
    handler.setFormatter(TerminalFormatter("%(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.getLogger("snarfcli").setLevel(logging.INFO)
    logging.raiseExceptions = False  # no trace of anything else that is logged wrongly
    warnings.formatwarning = _format_warning
    sys.excepthook = _print_trace


class _Handler(logging.StreamHandler):  # pyright: ignore[reportMissingTypeArgument]  # not generic in Python 3.10
    """Writes log records, and remembers why one could not be written."""

    failure: str | None = None

    def handleError(self, record: logging.LogRecord) -> None:
        error = sys.exc_info()[1]
        if isinstance(error, BrokenPipeError):  # "| head" has seen enough
            abandon_output()
        elif isinstance(error, OSError):
            _Handler.failure = error.strerror or type(error).__name__


def abandon_output() -> None:
    """Drop what waits to be written to standard output, and what follows: Python would try again at its exit, and fail."""
    with contextlib.suppress(OSError, ValueError):  # it is no file
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def output_failure() -> str | None:
    """Return why some of what was logged could not be written to standard output, None if all was."""
    return _Handler.failure


def print_error(text: str) -> None:
    """Print one message on standard error, if that still exists: the terminal may be closed."""
    with contextlib.suppress(OSError, ValueError):
        print(terminal_text(text), file=sys.stderr, flush=True)


def _format_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    return terminal_text(_original_format(message, category, filename, lineno, line))


def _print_trace(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    print_error("".join(traceback.format_exception(kind, error, trace)).rstrip())


_original_format = warnings.formatwarning
