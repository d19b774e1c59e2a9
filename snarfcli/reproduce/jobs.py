"""One run of a plan: runs its commands for samples, training and evaluation, and records the status of each stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.evaluation.report import STORE_SPLITS
from snarfcli.files import read_json, remove_temporaries, write_json
from snarfcli.locks import locked
from snarfcli.output_locks import clear_killed
from snarfcli.reproduce.failures import AGAIN, ALONE, reason_of, retry_of
from snarfcli.reproduce.plans import EvaluationStage, Job
from snarfcli.reproduce.running import JobStopped, Runner, processor_s_of_children, run_command
from snarfcli.reproduce.speed import count_steps, timed_arguments
from snarfcli.samples.layout import samples_folder
from snarfcli.texts import one_line

__all__ = [
    "LOG",
    "STATES",
    "STATUS",
    "JobStatus",
    "evaluations_to_make",
    "is_evaluated",
    "read_job_status",
    "read_status",
    "run_job",
]

STATUS = "reproduce.json"
"""Name of the status file in the run folder."""
LOG = "reproduce.log"
"""Name of the file in the run folder with the output of its commands."""

STATES = ("running", "done", "failed", "diverged", "stopped")
"""States of a run."""

_LOCK = ".reproduce.lock"


@dataclass(frozen=True)
class JobStatus:
    """Status of a run."""

    state: str
    """One of `STATES`."""
    digest: str = ""
    """Hash of the settings that it was trained with."""
    trained: bool = False
    """Whether the avatar exists."""
    stage: str = ""
    """samples, speed, train, id or ood: the stage that is running or has failed."""
    reason: str = ""
    """Reason of a failure, one line."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Duration of each stage of the last call; stages with nothing to do are left out."""
    spent_s: dict[str, float] = field(default_factory=dict)
    """Duration of each stage in all calls together; a call that was killed is left out."""
    processor_s: dict[str, float] = field(default_factory=dict)
    """Processor time of the commands of each stage in all calls together; none where the system does not tell it."""
    tries: int = 1
    """How often the last call has tried it."""
    retry: str = ""
    """Whether it may help to try a failed run once more: `failures.AGAIN` or `failures.ALONE`; empty if not."""
    steps: int | None = None
    """Number of training steps that fit into the minutes of the job, as it was measured; None if the job has no such budget."""


def run_job(
    job: Job,
    *,
    stopped: Callable[[], bool] = lambda: False,
    runner: Runner | None = None,
    threads: Callable[[], int | None] = lambda: None,
    tries: int = 1,
) -> JobStatus:
    """Run the missing stages of a run, and return and record its status.

    Existing samples, an avatar trained with the same settings, and evaluations newer than the avatar are kept. A run that
    diverged is not repeated: with the same seed it would diverge again.

    Args:
        job: the run.
        stopped: called regularly; when it returns True, the running command is interrupted and can write a checkpoint.
        runner: runs the commands.
        threads: returns the number of threads for the next command that does not name it; None leaves it to the command.
        tries: number of this try.
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
                status = _Stages(job, stopped, runner, threads, tries).run()
            except (JobStopped, KeyboardInterrupt):
                status = replace(read_status(folder) or JobStatus("stopped", job.digest), state="stopped")
            write_json(folder / STATUS, asdict(status))
    except (JobStopped, KeyboardInterrupt):  # before any stage, so the recorded status is still true
        status = JobStatus("stopped", job.digest)
    return status


def read_status(folder: Path) -> JobStatus | None:
    """Return the recorded status of the run in a folder, or None without one that can be read."""
    return read_job_status(folder / STATUS)


def read_job_status(path: Path) -> JobStatus | None:
    """Return the status in a file, or None without one that can be read.

    Raises:
        OSError, MemoryError: the system cannot read it.
    """
    try:
        status = read_described(JobStatus, read_json(path), "status", ignore_unknown=True)
    except (UserError, DescriptionError):
        return None
    retry = status.retry if status.retry in (AGAIN, ALONE) else ""
    steps = None if status.steps is None or status.steps < 1 else status.steps
    status = replace(status, stage=one_line(status.stage, 20), reason=one_line(status.reason, 500), retry=retry, steps=steps)
    return status if status.state in STATES else None


def is_evaluated(evaluation: EvaluationStage, avatar: Path) -> bool:
    """Return whether an evaluation exists, is newer than the avatar and has the wanted settings."""
    path = Path(evaluation.metrics)
    if not path.is_file() or not avatar.is_file() or path.stat().st_mtime < avatar.stat().st_mtime:
        return False
    try:
        content = read_json(path)
    except UserError:
        return False
    settings = content.get("settings") if isinstance(content, dict) else None
    return isinstance(settings, dict) and all(settings.get(key) == value for key, value in evaluation.settings.items())


def evaluations_to_make(job: Job) -> list[EvaluationStage]:
    """Return the evaluations of a trained run that do not count yet: missing ones, and those to be repeated.

    Left out are missing ones of a split of which the samples are known to have no frames, or are not there.
    """
    avatar = Path(job.folder) / "avatar.pt"

    def can_be_made(one: EvaluationStage) -> bool:
        samples = samples_folder(one.data_root, one.data, job.subject)
        return Path(one.metrics).is_file() or bool(_frames(samples, STORE_SPLITS[one.split]))

    return [one for one in job.evaluations if not is_evaluated(one, avatar) and can_be_made(one)]


class _Stages:
    """The stages of one run, in order."""

    def __init__(
        self, job: Job, stopped: Callable[[], bool], runner: Runner, threads: Callable[[], int | None], tries: int
    ) -> None:
        self.job, self.stopped, self.runner, self.threads = job, stopped, runner, threads
        self.folder = Path(job.folder)
        self.avatar = self.folder / "avatar.pt"
        self.before = read_status(self.folder) or JobStatus("stopped")
        same = self.before.digest == job.digest
        trained = same and self.before.trained and self.avatar.is_file()
        self.status = JobStatus("running", job.digest, trained, tries=tries)
        if same:
            before = self.before
            self.status = replace(self.status, steps=before.steps, spent_s=before.spent_s, processor_s=before.processor_s)

    def run(self) -> JobStatus:
        """Run the stages and return the final status."""
        for output in (self.folder, *(Path(one.metrics).parent for one in self.job.evaluations)):
            clear_killed(output)  # of commands that had all but ended, so that they are not run again
        remove_temporaries(self.folder, STATUS)
        if self.before.state == "diverged" and self.before.digest == self.job.digest and self._has_diverged():
            return replace(self.before, seconds={})
        for samples in self.job.samples:
            if not _samples_exist(samples.folder) and not self._stage("samples", samples.arguments):
                return self.status
        if not (self.status.trained and (self.folder / "metrics.json").is_file()):
            arguments = self._train_arguments()
            if arguments is None or not self._stage("train", arguments):
                return self.status
            self._write(trained=True)
        for evaluation in self.job.evaluations:
            if not is_evaluated(evaluation, self.avatar) and self._can_be_evaluated(evaluation):
                # so that an older evaluation is not taken for this one
                Path(evaluation.metrics).unlink(missing_ok=True)
                if not self._stage(evaluation.split, evaluation.arguments):
                    return self.status
        return replace(self.status, state="done", stage="", reason="")

    def _check(self) -> None:
        if self.stopped():
            raise JobStopped

    def _train_arguments(self) -> Sequence[str] | None:
        """Return the arguments of the training; None if its number of steps could not be measured, and `status` has the reason.

        A number that was measured before is kept, since a training can only be continued with the same one.
        """
        if self.job.minutes is None:
            return self.job.train
        if self.status.steps is None:
            try:
                steps = count_steps(self.job, lambda arguments: self._stage("speed", arguments))
            except UserError as error:
                self.status = replace(self.status, state="failed", reason=str(error))
                return None
            if steps is None:
                return None
            self._write(steps=steps)
        assert self.status.steps is not None
        return timed_arguments(self.job, self.status.steps)

    def _stage(self, name: str, arguments: Sequence[str]) -> bool:
        """Run one command and return whether it succeeded; otherwise `status` has the reason."""
        self._check()
        self._write(stage=name)
        log = self.folder / LOG
        begin = log.stat().st_size if log.exists() else 0
        start, processor_start = time.monotonic(), processor_s_of_children()
        try:
            code = self.runner(self._with_threads(arguments), log, self.stopped)
        finally:
            self._count(name, time.monotonic() - start, processor_s_of_children() - processor_start)
        if code == 0:
            return True
        self._check()
        diverged, reason = name == "train" and self._has_diverged(), reason_of(log, begin, code)
        retry = retry_of(code, reason) if self.status.tries == 1 and not diverged else ""
        self.status = replace(self.status, state="diverged" if diverged else "failed", reason=reason, retry=retry)
        return False

    def _with_threads(self, arguments: Sequence[str]) -> Sequence[str]:
        """Return the arguments of a command with its share of the threads."""
        threads = self.threads() if arguments[0] in ("train", "eval") else None
        has_threads = any(argument.startswith("threads=") for argument in arguments)
        return arguments if threads is None or has_threads else (*arguments, f"threads={threads}")

    def _count(self, name: str, spent_s: float, processor_s: float) -> None:
        """Add to the times of a stage and record them."""
        status = self.status
        self._write(
            seconds=_plus(status.seconds, name, spent_s), spent_s=_plus(status.spent_s, name, spent_s),
            processor_s=_plus(status.processor_s, name, processor_s) if processor_s else status.processor_s,
        )  # fmt: skip

    def _has_diverged(self) -> bool:
        try:
            content = read_json(self.folder / "metrics.json")
        except UserError:
            return False
        return isinstance(content, dict) and content.get("status") == "diverged"

    def _can_be_evaluated(self, evaluation: EvaluationStage) -> bool:
        """Return whether the samples have frames of this split; a data set without them is no failure of the run."""
        folder = samples_folder(evaluation.data_root, evaluation.data, self.job.subject)
        return _frames(folder, STORE_SPLITS[evaluation.split]) != 0

    def _write(self, **changes: Any) -> None:
        self.status = replace(self.status, **changes)
        write_json(self.folder / STATUS, asdict(self.status))


def _plus(times: dict[str, float], name: str, seconds: float) -> dict[str, float]:
    """Return times by stage, with more for one of them."""
    return times | {name: round(times.get(name, 0.0) + seconds, 2)}


def _samples_exist(folder: str) -> bool:
    return (Path(folder) / "manifest.json").is_file()  # written last


def _frames(folder: Path, split: str) -> int | None:
    """Return the number of frames of a split in the samples; None if it is unknown."""
    try:
        content = read_json(folder / "manifest.json")
    except UserError:
        return None
    frames = content.get("frames") if isinstance(content, dict) else None
    count = frames.get(split) if isinstance(frames, dict) else None
    return count if type(count) is int else None
