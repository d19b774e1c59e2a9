"""One run of a plan: samples, training and evaluation, each a command of its own, with what became of it written down."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json
from snarfcli.locks import locked
from snarfcli.reproduce.plans import Evaluation, Job
from snarfcli.samples.store import samples_folder

__all__ = ["LOG", "STATUS", "JobStopped", "Status", "is_evaluated", "read_status", "run_command", "run_job"]

STATUS = "reproduce.json"
"""Name of the file in the run's folder that says what became of it."""
LOG = "reproduce.log"
"""Name of the file in the run's folder with what its commands said."""

_LOCK = ".reproduce.lock"
_LOOK_EVERY_S = 0.3
# What a step of training, a frame of an evaluation and a checkpoint may take before a command is ended the hard way.
_PATIENCE_S = 90.0


class JobStopped(Exception):
    """The plan was interrupted."""


@dataclass(frozen=True)
class Status:
    """What became of a run so far."""

    state: str
    """running, done, failed, diverged or stopped."""
    digest: str = ""
    """Of the settings that it was trained with."""
    trained: bool = False
    """Whether the avatar is there."""
    stage: str = ""
    """samples, train, id or ood: what it is at, or where it failed."""
    reason: str = ""
    """Why it failed, one line."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time that the stages of the last call took; those that had nothing to do are left out."""


Runner = Callable[[Sequence[str], Path, Callable[[], bool]], int]
"""Runs `snarf` with arguments, appends what it says to a file, asks now and then whether to stop; returns its exit code."""


def run_job(job: Job, *, stopped: Callable[[], bool] = lambda: False, runner: Runner | None = None) -> Status:
    """Do what is missing of a run, and return and write down what became of it.

    What is there already is kept: samples, an avatar trained with the same settings, evaluations that are newer than it. A run
    that diverged stays so, since the same seed would lead there again.

    Args:
        job: the run.
        stopped: asked now and then; once it is true the running command gets the chance to write a checkpoint.
        runner: runs the commands.
    """
    folder = Path(job.folder)
    runner = runner or run_command

    def check() -> None:
        if stopped():
            raise JobStopped

    try:
        check()
        with locked(folder / _LOCK, check):
            try:
                status = _Stages(job, stopped, runner).run()
            except (JobStopped, KeyboardInterrupt):
                status = replace(read_status(folder) or Status("stopped", job.digest), state="stopped")
            write_json(folder / STATUS, asdict(status))
    except (JobStopped, KeyboardInterrupt):  # before it began, so that what is written there stays true
        status = Status("stopped", job.digest)
    return status


def read_status(folder: Path) -> Status | None:
    """Return what became of the run in a folder, or None if nothing is known."""
    try:
        content = read_json(folder / STATUS)
        return Status(**content)
    except (UserError, TypeError):
        return None


def is_evaluated(evaluation: Evaluation, avatar: Path) -> bool:
    """Return whether an evaluation is there, newer than the avatar and made with the wanted settings."""
    path = Path(evaluation.metrics)
    if not path.is_file() or not avatar.is_file() or path.stat().st_mtime < avatar.stat().st_mtime:
        return False
    try:
        settings = read_json(path)["settings"]
    except (UserError, KeyError, TypeError):
        return False
    return all(settings.get(key) == value for key, value in evaluation.settings.items())


class _Stages:
    """The stages of one run, one after the other."""

    def __init__(self, job: Job, stopped: Callable[[], bool], runner: Runner) -> None:
        self.job, self.stopped, self.runner = job, stopped, runner
        self.folder = Path(job.folder)
        self.avatar = self.folder / "avatar.pt"
        self.before = read_status(self.folder) or Status("stopped")
        same = self.before.digest == job.digest
        self.status = Status("running", job.digest, trained=same and self.before.trained and self.avatar.is_file())

    def run(self) -> Status:
        if self.before.state == "diverged" and self.before.digest == self.job.digest and self._has_diverged():
            return replace(self.before, seconds={})
        for samples in self.job.samples:
            if not _are_there(samples.folder):
                place = Path(samples.folder)
                with locked(place.with_name(f".{place.name}.lock"), self._check):
                    if not _are_there(samples.folder) and not self._stage("samples", samples.arguments):
                        return self.status
        if not self.status.trained:
            if not self._stage("train", self.job.train):
                return self.status
            self._write(trained=True)
        for evaluation in self.job.evaluations:
            if not is_evaluated(evaluation, self.avatar) and self._can_be_evaluated(evaluation):
                # an older evaluation must not pass for this one's
                Path(evaluation.metrics).unlink(missing_ok=True)
                if not self._stage(evaluation.split, evaluation.arguments):
                    return self.status
        return replace(self.status, state="done", stage="", reason="")

    def _check(self) -> None:
        if self.stopped():
            raise JobStopped

    def _stage(self, name: str, arguments: Sequence[str]) -> bool:
        """Run one command; return whether it went well, else `status` says why not."""
        self._check()
        self._write(stage=name)
        start, log = time.monotonic(), self.folder / LOG
        begin = log.stat().st_size if log.exists() else 0
        code = self.runner(arguments, log, self.stopped)
        spent = self.status.seconds.get(name, 0.0) + time.monotonic() - start
        self._write(seconds={**self.status.seconds, name: round(spent, 2)})
        if code == 0:
            return True
        self._check()
        diverged = name == "train" and self._has_diverged()
        self.status = replace(self.status, state="diverged" if diverged else "failed", reason=_reason(log, begin, code))
        return False

    def _has_diverged(self) -> bool:
        try:
            return read_json(self.folder / "metrics.json").get("status") == "diverged"
        except (UserError, AttributeError):
            return False

    def _can_be_evaluated(self, evaluation: Evaluation) -> bool:
        """Return whether the samples have frames of this split; data without them is no failure of the run."""
        folder = samples_folder(evaluation.data_root, evaluation.data, self.job.subject)
        return _frames(folder, "test" if evaluation.split == "id" else "ood") != 0

    def _write(self, **changes: Any) -> None:
        self.status = replace(self.status, **changes)
        write_json(self.folder / STATUS, asdict(self.status))


def run_command(arguments: Sequence[str], log: Path, stopped: Callable[[], bool]) -> int:
    """Run `snarf` in a process of its own and return its exit code; see `Runner`.

    Raises:
        JobStopped: it was to stop and has ended.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        file.write(f"$ snarf {' '.join(arguments)}\n")
        file.flush()
        process = subprocess.Popen(
            [sys.executable, "-m", "snarfcli", *arguments], stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT
        )
        asked_s: float | None = None
        while True:
            try:
                code = process.wait(_LOOK_EVERY_S)
                break
            except subprocess.TimeoutExpired:
                if asked_s is None and stopped():
                    # Ctrl-C, by which a training writes its checkpoint
                    process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)
                    asked_s = time.monotonic()
                elif asked_s is not None and time.monotonic() - asked_s > _PATIENCE_S:
                    process.kill()
            except BaseException:
                process.kill()
                process.wait()
                raise
    if asked_s is not None and code != 0:
        raise JobStopped
    return code


def _are_there(folder: str) -> bool:
    return (Path(folder) / "manifest.json").is_file()  # written last


def _frames(folder: Path, split: str) -> int | None:
    """Return how many frames of a split the samples have; None if nobody knows."""
    try:
        return int(read_json(folder / "manifest.json")["frames"][split])
    except (UserError, KeyError, TypeError, ValueError):
        return None


def _reason(log: Path, begin: int, code: int) -> str:
    """Return why a command failed: its last line, which is its message, without its name."""
    with log.open("rb") as file:
        file.seek(begin)
        lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    last = lines[-1] if len(lines) > 1 else ""
    if code < 0:
        name = signal.Signals(-code).name if -code in [one.value for one in signal.Signals] else f"signal {-code}"
        why = " (out of memory?)" if name == "SIGKILL" else ""
        return f"ended by {name}{why}"
    return last.removeprefix("snarf ").partition(": ")[2] if last.startswith("snarf ") else last or f"exit code {code}"
