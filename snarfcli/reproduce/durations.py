"""How long runs take: from finished runs, else from measured steps, else roughly from the experiment.

Processor time orders the runs, since other work on the machine hardly changes it. The time left of a plan needs the time that
a run takes on a machine without other work.
"""

from __future__ import annotations

import contextlib
import heapq
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json
from snarfcli.reproduce.jobs import read_status
from snarfcli.reproduce.plans import Job
from snarfcli.reproduce.results import look_up

__all__ = ["Duration", "Durations", "Estimate", "longest_first", "machine_name", "plan_seconds", "time_text"]

_EVALUATIONS_HINT_S = 30.0  # both evaluations of a built-in subject on one core, with the start of the commands
_LONGEST_S = 1e10  # longer ones are from damaged files
_MOST_RUNS = 5  # kept of each kind; the estimate is their median


@dataclass(frozen=True)
class Duration:
    """Times of one run, with the start of its commands."""

    train_s: float
    """Duration of the training."""
    evaluations_s: float
    """Duration of all evaluations."""
    train_processor_s: float
    """Processor time of the training, of all threads."""
    evaluations_processor_s: float
    """Processor time of all evaluations."""
    threads: int
    """Number of threads that it had."""
    machine: str
    """The machine; see `machine_name`."""
    gpu: str = ""
    """The GPU that it used; empty without one."""

    def undisturbed(self, threads: int) -> tuple[float, float]:
        """Return the durations of training and evaluations with a number of threads, on a machine without other work.

        On processors a run takes at most its processor time, since one of its threads always computes.
        """
        if self.gpu:
            return self.train_s, self.evaluations_s
        if threads != self.threads:
            return self.train_processor_s, self.evaluations_processor_s
        return min(self.train_s, self.train_processor_s), min(self.evaluations_s, self.evaluations_processor_s)


@dataclass(frozen=True)
class Estimate:
    """How long a run will take."""

    train_s: float
    """Duration of the training on a machine without other work."""
    evaluations_s: float
    """Duration of all evaluations."""
    processor_s: float
    """Processor time of both."""
    source: str
    """runs (finished runs of the kind), steps (measured steps), budget (the minutes of the row) or hint."""

    @property
    def total_s(self) -> float:
        """Duration of the run."""
        return self.train_s + self.evaluations_s


@dataclass(frozen=True)
class _Kind:
    """What the file knows about the runs of one kind."""

    row: str = ""
    """Name of the row, for readers of the file."""
    runs: tuple[Duration, ...] = ()
    """The latest finished runs."""
    steps: Duration | None = None
    """A run as it was computed from measured steps."""


@dataclass(frozen=True)
class _Content:
    """Content of the file."""

    kinds: dict[str, _Kind] = field(default_factory=dict)
    """By `Job.kind`."""


class Durations:
    """Known durations of runs, and estimates from them.

    Args:
        path: file that keeps them; one that is missing or damaged counts as empty.
        jobs: jobs of the plan. Those that are finished count, too.
        machine: name of the machine whose durations count; None for any, as on a cluster.
        threads: number of threads per job.
    """

    def __init__(self, path: Path, jobs: Sequence[Job], machine: str | None, threads: int) -> None:
        self.path, self.machine, self.threads = path, machine, threads
        self._hints_s = {job.kind: job.hint_s for job in jobs}
        self._kinds = _read(path)
        for job in jobs:
            duration = finished_duration(job)
            if duration is not None and not self._usable(self._kinds.get(job.kind, _Kind()).runs):
                self._add_run(job, duration)

    def of(self, job: Job) -> Estimate:
        """Return how long a run will take."""
        known = self._kinds.get(job.kind, _Kind())
        for source, durations in (("runs", known.runs), ("steps", (known.steps,) if known.steps else ())):
            usable = self._usable(durations)
            if usable:
                train_s, evaluations_s = (
                    statistics.median(times) for times in zip(*(one.undisturbed(self.threads) for one in usable), strict=True)
                )
                processor_s = statistics.median(one.train_processor_s + one.evaluations_processor_s for one in usable)
                return Estimate(train_s, evaluations_s, processor_s, source)
        source, train_s = ("hint", job.hint_s * self._scale()) if job.minutes is None else ("budget", 60 * job.minutes)
        return Estimate(train_s, _EVALUATIONS_HINT_S, train_s + _EVALUATIONS_HINT_S, source)

    def note_run(self, job: Job) -> None:
        """Remember a run that has just finished, and write the file."""
        duration = finished_duration(job)
        if duration is not None:
            self._add_run(job, duration)
            self._write()

    def note_steps(self, job: Job, duration: Duration) -> None:
        """Remember a run as it was computed from measured steps, and write the file."""
        known = self._kinds.get(job.kind, _Kind())
        self._kinds[job.kind] = _Kind(job.row, known.runs, duration)
        self._write()

    def _add_run(self, job: Job, duration: Duration) -> None:
        known = self._kinds.get(job.kind, _Kind())
        self._kinds[job.kind] = _Kind(job.row, (*known.runs, duration)[-_MOST_RUNS:], known.steps)

    def _usable(self, durations: Sequence[Duration]) -> list[Duration]:
        return [one for one in durations if self.machine in (None, one.machine)]

    def _scale(self) -> float:
        """Return how much longer trainings take than their hints say, from the rows whose duration is known."""
        ratios = []
        for kind, hint_s in self._hints_s.items():
            known = self._kinds.get(kind, _Kind())
            usable = self._usable(known.runs) or self._usable((known.steps,) if known.steps else ())
            if usable and hint_s > 0:
                ratios.append(usable[-1].train_processor_s / hint_s)
        return statistics.median(ratios) if ratios else 1.0

    def _write(self) -> None:
        """Write what is known, with what other calls have written meanwhile; a disk that is full does not stop the runs."""
        with contextlib.suppress(OSError):
            self._kinds = _read(self.path) | self._kinds
            write_json(self.path, asdict(_Content(self._kinds)))


def finished_duration(job: Job) -> Duration | None:
    """Return the times of a finished run, None if it is not finished or its files do not tell them.

    A run of an older version has no times of all its calls. Then those of its steps and evaluations stand for them.
    """
    folder = Path(job.folder)
    status = read_status(folder)
    if status is None or status.state != "done" or status.digest != job.digest:
        return None
    trained = _read_dict(folder / "metrics.json")
    machine = trained.get("machine")
    step_s, steps = look_up(trained, ("timings", "seconds_per_step")), look_up(trained, ("steps",))
    if not isinstance(machine, dict) or step_s is None or steps is None:
        return None
    spent, processor = status.spent_s, status.processor_s
    train_s = max(_of_training(spent), step_s * steps)
    evaluated = [one for one in job.evaluations if Path(one.metrics).is_file()]
    evaluations = {one.split: spent.get(one.split) or _wall_s(Path(one.metrics)) for one in evaluated}
    threads, gpu = machine.get("threads"), machine.get("gpu")
    return Duration(
        train_s, round(sum(evaluations.values()), 2),
        max(_of_training(processor), look_up(trained, ("timings", "processor_s")) or 0.0) or train_s,
        sum(processor.get(split) or seconds for split, seconds in evaluations.items()),
        threads if type(threads) is int else 1, machine_name(machine), gpu if isinstance(gpu, str) else "",
    )  # fmt: skip


def _of_training(times: dict[str, float]) -> float:
    """Return the time of a training and, with a budget of minutes, of the short one before it."""
    return times.get("train", 0.0) + times.get("speed", 0.0)


def machine_name(machine: dict[str, Any]) -> str:
    """Return the name of a machine for comparison, from the facts that a result records about it."""
    return f"{machine.get('processor')}, {machine.get('cores')} cores"


def longest_first(jobs: Sequence[Job], durations: Durations) -> list[Job]:
    """Return jobs by seed, in the order of their seeds, and those of a seed by processor time, the longest first.

    A table with one seed is whole early, and the last runs of the plan are short, so that no core waits long for another.
    """
    seeds = list(dict.fromkeys(job.seed for job in jobs))
    return sorted(jobs, key=lambda job: (seeds.index(job.seed), -durations.of(job).processor_s))


def plan_seconds(seconds: Sequence[float], processes: int) -> float:
    """Return how long runs take that are started in order, each as soon as one of the processes is free."""
    free = [0.0] * max(1, processes)
    for one in seconds:
        heapq.heappush(free, heapq.heappop(free) + one)
    return max(free)


def time_text(seconds: float) -> str:
    """Return a duration with the precision that an estimate has: 40 s, 12 min, 3 h 05 min."""
    seconds = seconds if seconds < _LONGEST_S else _LONGEST_S  # also for NaN
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def _read(path: Path) -> dict[str, _Kind]:
    """Return what a file knows; nothing if it is missing or damaged."""
    try:
        return read_described(_Content, read_json(path), "durations", ignore_unknown=True).kinds
    except (UserError, DescriptionError, OSError):
        return {}


def _read_dict(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except (UserError, OSError):
        return {}
    return content if isinstance(content, dict) else {}


def _wall_s(metrics: Path) -> float:
    return look_up(_read_dict(metrics), ("timings", "wall_s")) or 0.0
