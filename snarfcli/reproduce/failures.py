"""Why a command of a run has failed, and whether it can help to try the run again."""

from __future__ import annotations

import errno
import re
import signal
from pathlib import Path

from snarfcli.errors import LOST_DRIVE, is_out_of_memory
from snarfcli.texts import one_line

__all__ = ["AGAIN", "ALONE", "reason_of", "retry_of", "retry_of_error"]

AGAIN = "again"
"""The cause may have passed when the other runs of the plan have ended."""
ALONE = "alone"
"""There was not enough memory; there may be when no other run works."""

# Signals of crashes, and SIGKILL, which the system sends when memory runs out.
_SIGNALS = {"SIGKILL": ALONE, "SIGBUS": AGAIN, "SIGSEGV": AGAIN, "SIGABRT": AGAIN}
# Words of the commands' own messages (`cli.messages`, `errors`, `parallel`). A full disk, a wrong setting and damaged data stay
# as they are until the user changes something.
_MEMORY = re.compile(r"(?:not enough|out of|more) memory|memory ran out")
_DRIVE = re.compile(r"network drive|disk reports an error")
_USER_ERROR = 2
_LONGEST = 2000  # characters of a reason


def reason_of(log: Path, begin: int, code: int) -> str:
    """Return why a command failed, as one line: the last one of its output, without the name of the command.

    Args:
        log: file with its output.
        begin: where that begins, bytes.
        code: its exit code, or the negative number of the signal that ended it.
    """
    with log.open("rb") as file:
        file.seek(begin)
        lines = [line.strip() for line in file.read().decode(errors="replace").splitlines()]
    said = [line for line in lines if line and not line.startswith("$ snarf ")]
    last = said[-1] if said else ""
    if code < 0:
        why = " (out of memory?)" if _signal_name(code) == "SIGKILL" else ""
        return f"ended by {_signal_name(code)}{why}"
    own = last.removeprefix("snarf ").partition(": ")[2] if last.startswith("snarf ") else ""
    return one_line(own or last, _LONGEST) or f"exit code {code}"


def retry_of(code: int, reason: str) -> str:
    """Return `AGAIN` or `ALONE` if it can help to run a command again that has failed, or an empty text.

    Args:
        code: its exit code, or the negative number of the signal that ended it.
        reason: what `reason_of` has returned.
    """
    if code < 0:
        return _SIGNALS.get(_signal_name(code), "")
    if code != _USER_ERROR:  # a fault of the program, or a request to end
        return ""
    return ALONE if _MEMORY.search(reason) else AGAIN if _DRIVE.search(reason) else ""


def retry_of_error(error: BaseException) -> str:
    """Return the same for an exception."""
    code = error.errno if isinstance(error, OSError) else None
    if is_out_of_memory(error) or code == errno.ENOMEM:
        return ALONE
    return AGAIN if code in LOST_DRIVE else ""


def _signal_name(code: int) -> str:
    known = -code in [one.value for one in signal.Signals]
    return signal.Signals(-code).name if known else f"signal {-code}"
