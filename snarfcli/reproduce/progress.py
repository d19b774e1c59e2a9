"""What the runs of a plan are doing, and how long the plan will take: read from their logs while they run, wherever that is."""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from snarfcli.progress import ProgressLines
from snarfcli.reproduce.durations import Durations, plan_seconds, time_text
from snarfcli.reproduce.jobs import LOG, JobStatus, evaluations_to_make, read_status
from snarfcli.reproduce.plans import Job
from snarfcli.reproduce.results import collect
from snarfcli.texts import counted, one_line

__all__ = ["PlanProgress", "StageProgress", "left_seconds", "read_progress"]

log = logging.getLogger(__name__)

_TAIL_BYTES = 16_384
_COMMAND = re.compile(r"\$ snarf (\w+)\b(?:.*\bsplit=(\w+))?.*")
_STEPS = re.compile(r"(?:resuming at )?step (\d{1,9}) of (\d{1,9})\b.*")
_ITEMS = re.compile(r".*: (\d{1,9}) of (\d{1,9}) (\w+), [\d.]+ \w+/s")
_STAGES = {"preprocess": "samples", "train": "train"}
_TITLES = {"samples": "samples", "speed": "speed", "train": "train", "id": "eval in", "ood": "eval out"}
_NAME_WIDTH = 30


@dataclass(frozen=True)
class StageProgress:
    """How far a command is."""

    stage: str | None
    """samples, train, id or ood; None if the log does not tell it."""
    done: int
    """Number of steps, frames or meshes that are done."""
    total: int
    """Number of all; at least 1."""
    unit: str
    """What is counted."""

    @property
    def share(self) -> float:
        """Share that is done, from 0 to 1."""
        return self.done / self.total


def read_progress(log: Path) -> StageProgress | None:
    """Return the progress of the last command in a log of commands, None if it has not said any.

    Only the end of the file is read. Anything may be in it: other lines are passed over.
    """
    stage, found = None, None
    for line in _last_lines(log):
        command = _COMMAND.fullmatch(line)
        if command is not None:
            stage, found = _STAGES.get(command[1], command[2]), None
            continue
        steps, items = _STEPS.fullmatch(line), _ITEMS.fullmatch(line)
        match = steps or items
        if match is not None and 0 <= int(match[1]) <= int(match[2]) != 0:
            unit = "steps" if items is None else one_line(items[3], _NAME_WIDTH)
            found = StageProgress(stage, int(match[1]), int(match[2]), unit)
    return found


def left_seconds(job: Job, durations: Durations) -> float:
    """Return how long a run still takes on a machine without other work; 0 for one that is done."""
    estimate, status = durations.of(job), read_status(Path(job.folder))
    if status is None or status.digest != job.digest:
        return estimate.total_s
    if status.state == "diverged":
        return 0.0
    found = read_progress(Path(job.folder) / LOG)
    share = found.share if found is not None and found.stage in (None, status.stage) else 0.0
    if not status.trained:
        return estimate.train_s * (1 - share if status.stage == "train" else 1.0) + estimate.evaluations_s
    parts = sum(1 - share if one.split == status.stage else 1.0 for one in evaluations_to_make(job))
    return estimate.evaluations_s * parts / max(1, len(job.evaluations))


class PlanProgress:
    """Shows the progress of a plan: a line when a run starts and when it ends, and lines about all that run at the time.

    Args:
        jobs: jobs in the order in which they start.
        processes: number of jobs at a time.
        durations: estimates; each run that ends is added to them.
        on_end: called after a run has ended, with its number; not for one that was done before.
    """

    def __init__(self, jobs: Sequence[Job], processes: int, durations: Durations, on_end: Callable[[int], None]) -> None:
        self.jobs, self.processes, self.durations, self.on_end = jobs, processes, durations, on_end
        self.done = 0
        """Number of runs that are done."""
        self.running: dict[int, float] = {}
        """Numbers of the jobs that run, with the time of their start."""
        self._ended: set[int] = set()
        self._taken_s, self._estimated_s = 0.0, 0.0  # of runs that ended in this call, to see how busy the machine is
        self._lines = ProgressLines()
        self._left_s = [left_seconds(job, durations) for job in jobs]

    def begin(self) -> None:
        """Say how much there is to do."""
        finished = sum(seconds == 0 for seconds in self._left_s)
        log.info("%s%s%s", counted(len(self.jobs), "run"), f", {finished} finished before" if finished else "", self._left())

    def on_change(self, number: int, status: JobStatus) -> None:
        """Note that a run has started or ended."""
        job = self.jobs[number]
        self._lines.hide()
        if status.state == "running":
            self.running[number] = time.monotonic()
            log.info("started: %s (%s)", job.name, Path(job.folder) / LOG)
            return
        self.running.pop(number, None)
        if status.state == "stopped" or status.retry:
            return
        self._ended.add(number)
        self._left_s[number] = 0.0
        self.done += status.state == "done"
        if status.state == "done" and "train" in status.seconds:
            self.durations.note_run(job)
            self._taken_s += sum(status.seconds.values()) - status.seconds.get("samples", 0.0)
            self._estimated_s += self.durations.of(job).total_s
        self._estimate_again()
        outcome = self._outcome(job, status)
        log.info("%d of %d: %s: %s%s", len(self._ended), len(self.jobs), job.name, outcome, self._left())
        if status.seconds or status.state != "done":
            self.on_end(number)

    def look(self) -> None:
        """Show what runs, if it is time."""
        if self.running and self._lines.is_due():
            self._lines.show(self.lines())

    def close(self) -> None:
        """Remove what was shown on a terminal."""
        self._lines.close()

    def lines(self) -> list[str]:
        """Return one line about the plan, and one per running job."""
        about = f"{self.done} of {counted(len(self.jobs), 'run')} done, {len(self.running)} running{self._left()}"
        return [about, *(self._line(number) for number in sorted(self.running))]

    def _line(self, number: int) -> str:
        job = self.jobs[number]
        status, found = read_status(Path(job.folder)), read_progress(Path(job.folder) / LOG)
        stage = status.stage if status is not None and status.state == "running" else ""
        far = ""
        if found is not None and found.stage in (None, stage):
            far = f"{100 * found.share:3.0f} %, {found.done} of {found.total} {found.unit}"
        since = f"for {time_text(time.monotonic() - self.running[number])}"
        return f"  {_TITLES.get(stage, stage or 'start'):8}  {far:26}  {since:>12}  {job.name}"

    def _outcome(self, job: Job, status: JobStatus) -> str:
        if status.state != "done":
            return f"{status.state} ({status.stage}: {status.reason})" if status.reason else status.state
        values = collect(job).values
        parts = [
            f"{name} " + "/".join(f"{values[key]:.1f}" if key in values else "-" for key in (f"{name}_id", f"{name}_ood"))
            for name in ("bbox", "surface")
        ]
        seconds = sum(status.seconds.values())
        return ", ".join([*parts, "IoU in/out of distribution", f"{seconds:.0f} s" if seconds else "existed already"])

    def _estimate_again(self) -> None:
        """Estimate the runs that are to come, since more is known now."""
        for number, job in enumerate(self.jobs):
            if number not in self._ended and self._left_s[number]:
                self._left_s[number] = left_seconds(job, self.durations)

    def _left(self) -> str:
        """Return an estimate of the time left."""
        for number in self.running:
            self._left_s[number] = left_seconds(self.jobs[number], self.durations)
        order = sorted(range(len(self.jobs)), key=lambda number: (number not in self.running, number))
        seconds = plan_seconds([self._left_s[number] for number in order], self.processes)
        if not seconds:
            return ""
        pace = max(1.0, self._taken_s / self._estimated_s) if self._estimated_s else 1.0
        return f"; about {time_text(seconds * pace)} left"


def _last_lines(log: Path) -> list[str]:
    """Return the lines at the end of a file, none if it cannot be read; the first one may be a part."""
    try:
        with log.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _TAIL_BYTES))
            return file.read(_TAIL_BYTES).decode(errors="replace").splitlines()
    except OSError:
        return []
