"""The results of runs: their files, and the numbers of the columns of a table."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.files import read_json
from snarfcli.reproduce.jobs import JobStatus, evaluations_to_make, is_evaluated, read_status
from snarfcli.reproduce.plans import Job

__all__ = [
    "COLUMNS",
    "MORE_COLUMNS",
    "NOT_RUN",
    "Cell",
    "Column",
    "Metrics",
    "Result",
    "collect",
    "look_up",
    "read_metrics",
    "summarise",
]


@dataclass(frozen=True)
class Column:
    """A column of a table: one number per run."""

    key: str
    """Name in the CSV file and in `papers.yaml`."""
    title: str
    """Heading."""
    meaning: str
    """Explanation in the report."""
    stage: str
    """File with the number: train, id or ood."""
    path: tuple[str, ...]
    """Keys that lead to it in the file."""
    scale: float = 1.0
    """Factor from the unit of the file to the unit of the table."""
    digits: int = 1
    """Decimals in the table."""


NOT_RUN = "not run yet"
"""Reason of a run that has not begun."""

_TIMES = "time for 200,000 points, milliseconds, scaled from smaller frames, on the machine named above"
COLUMNS = (
    Column("bbox_id", "bbox in", "IoU of uniform points in the papers' box, held-out motion, %", "id", ("iou_bbox",), 100),
    Column("surface_id", "surface in", "IoU of points near the surface, held-out motion, %", "id", ("iou_surface",), 100),
    Column("bbox_ood", "bbox out", "IoU of uniform points, out-of-distribution poses, %", "ood", ("iou_bbox",), 100),
    Column("surface_ood", "surface out", "IoU of points near the surface, out of distribution, %", "ood",
           ("iou_surface",), 100),
    Column("worst_ood", "worst frame out", "lowest surface IoU of a frame out of distribution, %", "ood",
           ("worst_iou_surface",), 100),
    Column("search_ms", "search ms", f"mapping to the canonical frame: {_TIMES}", "id", ("timings", "search_ms_per_200k")),
    Column("shape_ms", "shape ms", f"the network: {_TIMES}", "id", ("timings", "shape_ms_per_200k")),
    Column("total_ms", "total ms", f"total: {_TIMES}", "id", ("timings", "total_ms_per_200k")),
    Column("training_min", "training min", "number of steps times the time per step, without validation, minutes", "train", ()),
    Column("core_min", "core min", "processor time of the steps, all threads, without validation, minutes; other work on the "
           "machine changes it less than the time", "train", ("timings", "processor_s"), 1 / 60, 2),
)  # fmt: skip
"""The columns of every table."""

_BY_SPLIT = (
    ("chamfer", "Chamfer mm", "mean distance between extracted and true surfaces, both ways, mm",
     ("surfaces", "chamfer_m"), 1000, 2),
    ("normals", "normals", "mean cosine between the normals of both surfaces", ("surfaces", "normal_consistency"), 1, 3),
    ("f_score", "F 5 mm", "F-score at 5 mm of the extracted surface, %", ("surfaces", "f_score"), 100, 1),
    ("lost", "lost %", "inside points without a correspondence, %", ("inside_without_correspondence",), 100, 2),
    ("roots", "roots", "mean number of correspondences of points with at least one", ("correspondences_per_point",), 1, 2),
)  # fmt: skip
MORE_COLUMNS = (
    *(
        Column(f"{key}_{split}", f"{title} {short}", f"{meaning}, {long}", split, path, scale, digits)
        for key, title, meaning, path, scale, digits in _BY_SPLIT
        for split, short, long in (("id", "in", "held-out motion"), ("ood", "out", "out of distribution"))
    ),
    Column("wrong_share", "wrong weights %", "learned skinning weight that is on other bones than in the body model, %", "id",
           ("weights", "wrong_share"), 100),
    Column("right_bone", "right bone %", "vertices whose heaviest bone is the same as in the body model, %", "id",
           ("weights", "right_bone"), 100),
    Column("steps", "steps", "number of training steps", "train", ("steps",), 1, 0),
)  # fmt: skip
"""Columns of the second table; columns without a number are left out."""


@dataclass(frozen=True)
class Metrics:
    """A file of metrics of `snarf train` or `snarf eval`."""

    sequences: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Numbers of each sequence by its name."""
    machine: dict[str, Any] = field(default_factory=dict)
    """The machine."""
    versions: dict[str, Any] = field(default_factory=dict)
    """Versions of packages."""
    validations: list[dict[str, Any]] = field(default_factory=list)
    """Validations of a training, with the number of steps before each."""
    code: dict[str, Any] = field(default_factory=dict)
    """Version of the code; see `snarfcli.versions.recorded_code`."""
    earlier_code: list[dict[str, Any]] = field(default_factory=list)
    """Other versions that took the earlier steps of a training that was continued."""
    content: dict[str, Any] = field(default_factory=dict)
    """The whole file."""


@dataclass(frozen=True)
class Result:
    """One run: its numbers, or why it has none."""

    job: Job
    """The run."""
    state: str
    """done, failed, diverged, stopped or missing."""
    reason: str = ""
    """Reason if it is not done."""
    values: dict[str, float] = field(default_factory=dict)
    """Numbers by column key, in the units of the columns."""
    files: dict[str, Path] = field(default_factory=dict)
    """Files of the numbers, by stage: train, id, ood."""
    origins: dict[str, Metrics] = field(default_factory=dict)
    """Where these files come from, by stage: machine, versions and code."""
    spent_s: float | None = None
    """Duration of all its stages in all calls; None if it was not recorded."""
    processor_s: float | None = None
    """Processor time of all its commands; None if it was not recorded."""

    def unknown(self, column: Column) -> str | None:
        """Return why there is no number: failed, diverged, missing, or `none` if there is nothing to measure."""
        if column.key in self.values:
            return None
        if self.state == "done" or column.stage in self.files:
            return "none"
        return "missing" if self.state in ("stopped", "running") else self.state


@dataclass(frozen=True)
class Cell:
    """One number of a table, from one or several runs."""

    mean: float | None
    """Mean over the seeds of each subject, then over subjects, of the runs that have the number."""
    deviation: float | None
    """Standard deviation over seeds of the mean over subjects; None with one seed, or if a run has no number."""
    runs: int
    """Number of runs it should be from."""
    count: int
    """Number of runs that have it."""
    unknown: dict[str, int]
    """Number of runs without it, by reason: failed, diverged, missing, none."""

    def text(self, digits: int) -> str:
        """Return the text in the table. A mean of only some of the runs is always marked as such."""
        others = ", ".join(f"{count} {why}" for why, count in sorted(self.unknown.items()) if why != "none")
        if self.mean is None:
            if not others:
                return "–"
            return next(iter(self.unknown)) if self.runs == 1 else others
        number = f"{self.mean:.{digits}f}" + ("" if self.deviation is None else f" ± {self.deviation:.{digits}f}")
        return f"{self.count} of {self.runs}: {number} ({others})" if others else number


def collect(job: Job) -> Result:
    """Read the numbers of a run.

    Only files of the settings of the job are read: the avatar was trained with them, and the evaluation is newer than it.
    """
    folder = Path(job.folder)
    status = read_status(folder)
    if status is None:
        return Result(job, "missing", NOT_RUN)
    if status.digest != job.digest:
        return Result(job, "missing", f"{folder} has a run with other settings")
    values: dict[str, float] = {}
    files: dict[str, Path] = {}
    if status.trained and (folder / "avatar.pt").is_file() and (folder / "metrics.json").is_file():
        files["train"] = folder / "metrics.json"
    for evaluation in job.evaluations if "train" in files else ():
        if is_evaluated(evaluation, folder / "avatar.pt"):
            files[evaluation.split] = Path(evaluation.metrics)
    known = {stage: metrics for stage, path in files.items() if (metrics := _known(path)) is not None}
    damaged = [str(path) for stage, path in files.items() if stage not in known]
    files = {stage: files[stage] for stage in known}
    for column in (*COLUMNS, *MORE_COLUMNS):
        content = known[column.stage].content if column.stage in known else None
        value = None if content is None else _training_min(content) if not column.path else look_up(content, column.path)
        if value is not None:
            values[column.key] = value * column.scale
    origins = {stage: replace(metrics, sequences={}, content={}) for stage, metrics in known.items()}
    times = (sum(one.values()) if one else None for one in (status.spent_s, status.processor_s))
    state = _state(status, job, files)
    if damaged and status.state == "done":
        state = "missing", f"damaged: {', '.join(damaged)}; delete it and run the command again"
    return Result(job, *state, values, files, origins, *times)


def summarise(results: Sequence[Result], column: Column) -> Cell:
    """Return the number of a table for several runs, such as those of one row, or of one row and subject."""
    unknown: dict[str, int] = {}
    by_subject: dict[str, list[float]] = {}
    by_seed: dict[int, list[float]] = {}
    for result in results:
        why = result.unknown(column)
        if why is not None:
            unknown[why] = unknown.get(why, 0) + 1
            continue
        value = result.values[column.key]
        by_subject.setdefault(result.job.subject, []).append(value)
        by_seed.setdefault(result.job.seed, []).append(value)
    count = sum(map(len, by_subject.values()))
    if not count:
        return Cell(None, None, len(results), 0, unknown)
    mean = statistics.fmean(statistics.fmean(values) for values in by_subject.values())
    whole = not unknown and len(by_seed) > 1
    deviation = statistics.stdev(statistics.fmean(values) for values in by_seed.values()) if whole else None
    return Cell(mean, deviation, len(results), count, unknown)


def _state(status: JobStatus, job: Job, files: dict[str, Path]) -> tuple[str, str]:
    if status.state in ("failed", "diverged"):
        return status.state, f"{status.stage}: {status.reason}"
    if status.state == "done" and "train" not in files:
        return "missing", f"{job.folder} has no avatar any more"
    if status.state == "done":
        left = [one.split for one in evaluations_to_make(job)]
        why = "there is none of this avatar with these settings"
        return ("missing", f"evaluation {' and '.join(left)}: {why}") if left else ("done", "")
    return "stopped", f"interrupted at {status.stage or 'the start'}"


def read_metrics(path: Path) -> Metrics:
    """Return what the reports need of a file of metrics.

    Raises:
        UserError: the file is missing or damaged.
        OSError, MemoryError: the system cannot read it.
    """
    content = read_json(path, "metrics")
    try:
        known = read_described(Metrics, content, "metrics", ignore_unknown=True)
    except DescriptionError as error:
        raise UserError(f"metrics {path} are damaged ({error}); run the command that wrote them again") from None
    return replace(known, content=content)


def _known(path: Path) -> Metrics | None:
    """Return the numbers of a run; None if its file is damaged, so that the table shows the others."""
    try:
        return read_metrics(path)
    except UserError:
        return None


def look_up(content: Any, path: Sequence[str]) -> float | None:
    """Return the finite number that names lead to in nested dicts, or None if there is none."""
    for name in path:
        content = content.get(name) if isinstance(content, dict) else None
    is_number = isinstance(content, (int, float)) and not isinstance(content, bool)
    # The comparison also takes whole numbers that are too large for a float; it is false for NaN.
    return content if is_number and abs(content) <= sys.float_info.max else None


def _training_min(content: dict[str, Any]) -> float | None:
    """Return the time of the whole training. (The file of a resumed training has the wall time of its last part only.)"""
    step_s, steps = look_up(content, ("timings", "seconds_per_step")), look_up(content, ("steps",))
    return None if step_s is None or steps is None else step_s * steps / 60
