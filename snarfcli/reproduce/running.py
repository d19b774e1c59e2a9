"""Commands of `snarf` in new processes: with their output in a log, asked to end when the plan is to stop."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from snarfcli.locks import inherited_locks
from snarfcli.safe_start import safe_environment, snarf_command

__all__ = ["JobStopped", "Runner", "processor_s_of_children", "run_command"]

_LOOK_EVERY_S = 0.3
# Time between Ctrl-C and SIGKILL: a training step or a frame of an evaluation, and a checkpoint.
_PATIENCE_S = 90.0

Runner = Callable[[Sequence[str], Path, Callable[[], bool]], int]
"""Runs `snarf` with arguments, appends its output to a file, regularly asks whether to stop, and returns its exit code."""


class JobStopped(Exception):
    """The plan was interrupted."""


def run_command(arguments: Sequence[str], log: Path, stopped: Callable[[], bool]) -> int:
    """Run `snarf` in a new process and return its exit code; see `Runner`.

    The command waits while another one writes to its output folder, such as one that a killed `snarf reproduce` has left. It
    inherits the locks of this process, so that the run stays locked until the command has ended, however this process ends.

    Raises:
        JobStopped: it was interrupted because `stopped` returned True.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        file.write(f"$ snarf {' '.join(arguments)}\n")
        file.flush()
        process = subprocess.Popen(
            snarf_command([*arguments, "wait=true"]), env=safe_environment(),
            stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, pass_fds=inherited_locks(),
        )  # fmt: skip
        try:
            code, was_asked = _wait(process, stopped)
        except BaseException:
            process.kill()
            process.wait()
            raise
    if was_asked and code != 0:
        raise JobStopped
    return code


def _wait(process: subprocess.Popen[bytes], stopped: Callable[[], bool]) -> tuple[int, bool]:
    """Wait for a command; return its exit code, and whether it was asked to end.

    It is asked when `stopped` returns True, or this process is asked to end. A second request raises.
    """
    asked_s: float | None = None
    while True:
        try:
            return process.wait(_LOOK_EVERY_S), asked_s is not None
        except (subprocess.TimeoutExpired, KeyboardInterrupt) as reason:
            is_request = isinstance(reason, KeyboardInterrupt)
            if is_request and asked_s is not None:
                raise
            if asked_s is None and (is_request or stopped()):
                # as Ctrl-C, after which a training writes its checkpoint; but commands in the background ignore that
                process.terminate()
                asked_s = time.monotonic()
            elif asked_s is not None and time.monotonic() - asked_s > _PATIENCE_S:
                process.kill()


def processor_s_of_children() -> float:
    """Return the processor time of all commands that this process has waited for, of all their threads; 0 on Windows."""
    times = os.times()
    return times.children_user + times.children_system
