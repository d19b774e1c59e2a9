"""Reports that grow while their runs go on."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from snarfcli.errors import UserError
from snarfcli.output_locks import hold_output
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.report import write_report
from snarfcli.reproduce.results import Result, collect

__all__ = ["GrowingReports", "PlannedReport"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlannedReport:
    """A report that is to be written."""

    plan: Plan
    """Its plan."""
    folder: Path
    """Its folder."""
    command: str
    """The command line that makes it."""
    about: str = ""
    """Further facts about how it is run."""


class GrowingReports:
    """Writes the tables of some reports whenever a run has ended; a report that cannot be written does not stop the runs."""

    def __init__(self, reports: Sequence[PlannedReport]) -> None:
        self.reports = reports
        self._results = [{job.folder: collect(job) for job in report.plan.jobs} for report in reports]
        self._begun: set[Path] = set()  # folders of the reports that were written
        self._has_failed = False

    def update(self, ended: str, running: Collection[str]) -> None:
        """Write the reports that have a run.

        Args:
            ended: folder of the run that has just ended.
            running: folders of the runs that go on.
        """
        for report, results in zip(self.reports, self._results, strict=True):
            jobs = {job.folder: job for job in report.plan.jobs}
            if ended not in jobs:
                continue
            results[ended] = collect(jobs[ended])
            self._write(report, [_shown(results[folder], folder in running) for folder in jobs], is_growing=True)

    def stop(self) -> None:
        """Write the reports that were written before once more, after an interruption: nothing runs now."""
        for report in self.reports:
            if report.folder in self._begun:
                self._write(report, [collect(job) for job in report.plan.jobs], is_growing=False)

    def _write(self, report: PlannedReport, results: Sequence[Result], *, is_growing: bool) -> None:
        self._begun.add(report.folder)
        try:
            with hold_output(report.folder, "snarf reproduce"):
                write_report(report.plan, results, report.folder, report.command, about=report.about, is_growing=is_growing)
        except (UserError, OSError) as error:  # such as another call that is drawing the figures, or a full disk
            if not self._has_failed:
                log.warning("warning: the table of the runs so far was not written: %s", error)
            self._has_failed = True


def _shown(result: Result, is_running: bool) -> Result:
    return replace(result, state="running", reason="not finished yet") if is_running else result
