"""What a plan would run, and how long that would take."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path

from snarfcli.errors import UserError
from snarfcli.reproduce.durations import Durations, plan_seconds, time_text
from snarfcli.reproduce.measuring import Measurements
from snarfcli.reproduce.plans import Job, Plan
from snarfcli.reproduce.progress import left_seconds
from snarfcli.reproduce.running import JobStopped
from snarfcli.texts import counted

__all__ = ["measure_missing", "print_commands", "print_durations"]

log = logging.getLogger(__name__)

_SOURCES = {"runs": "finished runs", "steps": "measured steps", "budget": "its minutes", "hint": "not measured, rough"}


def print_commands(jobs: Sequence[Job]) -> None:
    """Print each run and its commands."""
    made: set[str] = set()
    for number, job in enumerate(jobs, 1):
        log.info("run %d of %d: %s: %s, %s", number, len(jobs), job.row, job.name, job.folder)
        for samples in job.samples:
            if samples.folder not in made and not (Path(samples.folder) / "manifest.json").exists():
                log.info("  snarf %s", " ".join(samples.arguments))
            made.add(samples.folder)
        if job.minutes is not None:
            log.info("  with as many training.steps as fit into %g minutes of one core, by short trainings before", job.minutes)
        for arguments in (job.train, *(evaluation.arguments for evaluation in job.evaluations)):
            log.info("  snarf %s", " ".join(arguments))


def measure_missing(plans: Sequence[Plan], jobs: Sequence[Job], durations: Durations) -> None:
    """Measure a short run of each kind whose duration is not known and that is still to be run.

    On Ctrl-C the other kinds are left out. What was measured is kept, so that it is not measured again.
    """
    data = {job.folder: plan.data_settings for plan in reversed(plans) for job in plan.jobs}
    unknown: dict[str, Job] = {}
    for job in jobs:
        if durations.of(job).source == "hint" and left_seconds(job, durations):
            unknown.setdefault(job.kind, job)
    if not unknown:
        return
    log.info(
        "\nmeasuring %s, about half a minute each; Ctrl-C leaves the others out, measure=false all",
        counted(len(unknown), "kind") + " of run",
    )
    with tempfile.TemporaryDirectory(prefix="snarf-") as folder:
        measurements = Measurements(Path(folder), durations.threads)
        try:
            for number, job in enumerate(unknown.values(), 1):
                log.info("measuring %d of %d: %s", number, len(unknown), job.row)
                try:
                    durations.note_steps(job, measurements.measure(job, data[job.folder]))
                except UserError as error:
                    log.warning("warning: row %s cannot be measured: %s", job.row, error)
        except (JobStopped, KeyboardInterrupt):
            log.info("stopped measuring")


def print_durations(jobs: Sequence[Job], durations: Durations, processes: int) -> None:
    """Print how long the runs of each row take, and the whole plan."""
    left_s = {job.folder: left_seconds(job, durations) for job in jobs}
    by_kind: dict[str, list[Job]] = {}
    for job in jobs:
        by_kind.setdefault(job.kind, []).append(job)
    width = max(len(job.row) for job in jobs)
    lines = [f"{'row':{width}}  {'data':8}  {'runs':>4}  {'to run':>6}  {'one run':>10}  {'all':>10}  from"]
    for some in by_kind.values():
        estimate, left = durations.of(some[0]), [left_s[job.folder] for job in some]
        times = f"{time_text(estimate.total_s):>10}  {time_text(sum(left)):>10}"
        counts = f"{len(some):4}  {sum(map(bool, left)):6}"
        lines.append(f"{some[0].row:{width}}  {some[0].data:8}  {counts}  {times}  {_SOURCES[estimate.source]}")
    log.info("\n%s\n", "\n".join(lines))
    missing = {stage.folder for job in jobs for stage in job.samples if not (Path(stage.folder) / "manifest.json").exists()}
    seconds = list(left_s.values())
    log.info(
        "%s to run: about %s with processes=%d, %s one after the other, on this machine without other work%s",
        counted(sum(map(bool, seconds)), "run"), time_text(plan_seconds(seconds, processes)), processes,
        time_text(sum(seconds)), f"; and {counted(len(missing), 'set')} of samples" if missing else "",
    )  # fmt: skip
