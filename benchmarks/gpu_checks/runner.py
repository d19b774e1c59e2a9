"""Run stages one after the other, each as a process with a time limit, and write the report after each."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpu_checks.report import empty_section, markdown
from snarfcli.errors import UserError
from snarfcli.files import atomic_path, read_json, write_json

__all__ = ["Ending", "Results", "Stage", "run_limited", "run_stages"]

_GRACE_S = 8.0  # from asking a process to end to ending it
_LEAST_S = 10.0  # a stage that has less time is not begun


@dataclass(frozen=True)
class Stage:
    """One part of the check."""

    name: str
    title: str
    seconds: float
    """Time limit."""


@dataclass(frozen=True)
class Ending:
    """How a process ended."""

    status: str
    """done, "stopped at its time limit" or "failed (exit code N)"."""
    seconds: float


class Results:
    """The report and its raw numbers: a Markdown file, and a JSON file of the same name beside it.

    Args:
        path: of the Markdown file.
        name: of the machine.
        facts: one paragraph about machine and command.
        stages: all stages, in the order of the report.
        is_dry: whether the numbers mean nothing, so that no goal is judged by them.
    """

    def __init__(self, path: Path, name: str, facts: str, stages: Sequence[Stage], is_dry: bool = False) -> None:
        self.path, self.stages = path, stages
        self.content: dict[str, Any] = {"name": name, "facts": facts, "is_dry": is_dry, "stages": {}}

    @property
    def json_path(self) -> Path:
        """The file with the raw numbers."""
        return self.path.with_suffix(".json")

    def load_finished(self) -> None:
        """Take over the stages of an earlier report that are done.

        Raises:
            UserError: there is no such report, or it is none.
        """
        try:
            stages = read_json(self.json_path, "earlier report")["stages"]
            self.content["stages"] = {name: stage for name, stage in stages.items() if stage["status"] == "done"}
        except (AttributeError, KeyError, TypeError):
            raise UserError(f"{self.json_path} is no report of gpu_check.py; leave out --resume to write a new one") from None

    def is_done(self, stage: Stage) -> bool:
        """Return whether a stage has ended well."""
        return self.content["stages"].get(stage.name, {}).get("status") == "done"

    def add(self, stage: Stage, ending: Ending, section: Mapping[str, Any], output: str) -> None:
        """Add a stage and write both files."""
        kept = "" if ending.status == "done" else output
        entry = {"status": ending.status, "seconds": round(ending.seconds, 1), "output": kept, "content": dict(section)}
        self.content["stages"][stage.name] = entry
        self.write()

    def write(self) -> None:
        """Write both files, each complete or not at all."""
        write_json(self.json_path, self.content)
        with atomic_path(self.path) as temporary:
            temporary.write_text(markdown(self.content, {stage.name: stage.title for stage in self.stages}))


def run_stages(
    results: Results,
    chosen: Sequence[Stage],
    command: Callable[[Stage, Path, float], list[str]],
    folder: Path,
    seconds: float,
    say: Callable[[str], None] = print,
) -> bool:
    """Run the stages that are not done yet, and return whether all of them are done then.

    Args:
        results: what is known; each stage is added as it ends.
        chosen: the stages.
        command: takes a stage, the path of its section, and its time limit in seconds; returns the command to run.
        folder: for sections and outputs.
        seconds: time for all stages together; those for which too little is left are not begun.
        say: takes one line per stage.
    """
    deadline = time.monotonic() + seconds
    folder.mkdir(parents=True, exist_ok=True)
    results.write()
    for stage in chosen:
        if results.is_done(stage):
            say(f"{stage.name}: done before")
            continue
        limit = min(stage.seconds, deadline - time.monotonic())
        section, log = folder / f"{stage.name}.json", folder / f"{stage.name}.log"
        section.unlink(missing_ok=True)
        log.write_text("")
        if limit < _LEAST_S:
            ending = Ending("not begun: no time was left", 0.0)
        else:
            say(f"{stage.name}: at most {limit:.0f} s ...")
            ending = run_limited(command(stage, section, limit), limit, log)
        output = log.read_text(errors="replace")
        results.add(stage, ending, _read_section(section), output)
        say(f"{stage.name}: {ending.status}, {ending.seconds:.1f} s")
        if ending.status.startswith("failed"):
            say("\n".join(output.splitlines()[-15:]))
    return all(results.is_done(stage) for stage in chosen)


def run_limited(
    command: Sequence[str], seconds: float, log: Path, environment: Mapping[str, str] | None = None, folder: Path | None = None
) -> Ending:
    """Run a command with its output in a file, and end it and all its processes when its time is over.

    It is asked to end (SIGTERM) shortly before, so that it can finish its files.

    Args:
        command: to run.
        seconds: time limit.
        log: file that gets its output.
        environment: of the process; None for this one's.
        folder: in which the process starts; None for this one's.
    """
    start = time.monotonic()
    grace_s = min(_GRACE_S, seconds / 4)
    with open(log, "ab") as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            cwd=folder,
            start_new_session=True,
        )
        stopped = False
        try:
            code = process.wait(seconds - grace_s)
        except subprocess.TimeoutExpired:
            stopped = True
            _signal(process, "SIGTERM")
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(grace_s)
            code = None
        finally:
            _signal(process, "SIGKILL")  # also what the process has left behind
            process.wait()
    status = "stopped at its time limit" if stopped else "done" if code == 0 else f"failed (exit code {code})"
    return Ending(status, time.monotonic() - start)


def _signal(process: subprocess.Popen, name: str) -> None:
    """Send a signal to a process and all in its group; where there are no groups, end the process."""
    if os.name != "posix":
        process.kill()
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, getattr(signal, name))


def _read_section(path: Path) -> dict[str, Any]:
    """Return what a stage has written, which may be nothing."""
    try:
        return empty_section() | json.loads(path.read_text())
    except (OSError, ValueError):
        return empty_section()


def python_command(script: Path, *arguments: object) -> list[str]:
    """Return the command that runs a script with this Python."""
    return [sys.executable, str(script), *(str(argument) for argument in arguments)]
