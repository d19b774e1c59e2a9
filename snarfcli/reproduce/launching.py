"""Run the jobs of a plan at the same time, watch their status, and try some that have failed once more.

DESIGN. `planned_jobs` is what a job does, wherever it runs; `launchers` starts the jobs. This module only reads their status
files, so it does not matter where they run. Runs that failed for want of memory, or for another reason that may pass, are
tried again when all others have ended.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from snarfcli.devices import why_no_gpu
from snarfcli.errors import UserError
from snarfcli.hydra_config.launchers import missing_plugin
from snarfcli.interrupts import signals_as_interrupts
from snarfcli.locks import try_lock
from snarfcli.output_locks import hold_output, lock_file, may_be_in_use
from snarfcli.parallel import choose_processes, count_cores
from snarfcli.reproduce.failures import AGAIN, ALONE
from snarfcli.reproduce.jobs import JobStatus
from snarfcli.reproduce.launchers import Launcher, Processes, start_processes
from snarfcli.reproduce.planned_jobs import VISIBLE_GPUS, PlannedJobs, ask_to_stop, read_result, write_plan
from snarfcli.reproduce.plans import Job
from snarfcli.slots import SLOT_VARIABLE

__all__ = ["check_launcher", "default_processes", "launch"]

log = logging.getLogger(__name__)

OnChange = Callable[[int, JobStatus], None]
"""Called with the number of a job and its status."""

_LOOK_EVERY_S = 0.5
_BYTES_EACH = 2**30  # measured for training=quick: 0.6 GB for a training, 0.3 GB for an evaluation


def check_launcher(name: str, settings: Sequence[str] = ()) -> None:
    """Check that a launcher is installed, and that it takes settings if there are any.

    Raises:
        UserError: it is not, or does not.
    """
    if (what_to_install := missing_plugin(name, "launcher")) is not None:
        raise UserError(what_to_install)
    if name == "local" and settings:
        raise UserError("launcher_settings: wanted none with launcher=local; give the launcher of Hydra that they are for")


def default_processes(launcher: str, jobs: int, device: str) -> int:
    """Return how many jobs run at a time if nothing else is wanted.

    That is one per GPU or, without one, one per core, as far as the free memory allows. On a cluster, which has a limit of its
    own, all jobs.

    Args:
        launcher: one of `LAUNCHERS`.
        jobs: number of jobs.
        device: auto, cpu, cuda or cuda:N.
    """
    if launcher == "submitit_slurm":
        return max(1, jobs)
    if device != "cpu" and why_no_gpu() is None:
        is_one = device not in ("auto", "cuda") or SLOT_VARIABLE in os.environ
        return 1 if is_one else max(1, min(torch.cuda.device_count(), jobs))
    return choose_processes(jobs, _BYTES_EACH)


def launch(
    jobs: Sequence[Job], folder: Path, launcher: Launcher, on_change: OnChange, on_look: Callable[[], None] | None = None
) -> list[JobStatus | None]:
    """Run jobs and return the status of each; None for a job that the launcher has not started.

    On Ctrl-C (or SIGTERM, SIGHUP) every running command writes its checkpoint; a second Ctrl-C kills all processes. If this
    process is killed, the jobs notice it and end likewise.

    Args:
        jobs: the jobs, in the order in which they are to be started.
        folder: for the plan and the files of the launcher.
        launcher: how the jobs are distributed.
        on_change: called with the number of a job and its status when it starts and when it ends.
        on_look: called about twice a second while jobs run.

    Raises:
        UserError: the launcher has not started any job.
        KeyboardInterrupt: interrupted; all processes have ended.
    """
    work = folder / secrets.token_hex(4)
    with hold_output(work, "snarf reproduce"):
        _remove_abandoned(folder)
        work.mkdir(parents=True)
        statuses = _Call(jobs, work, launcher, on_change, on_look).run()
    with contextlib.suppress(OSError):  # other calls have files there
        folder.rmdir()
    return statuses


class _Call:
    """One call of `launch`, with its files in the folder `work`, which is deleted when all jobs have ended as planned."""

    def __init__(
        self, jobs: Sequence[Job], work: Path, launcher: Launcher, on_change: OnChange, on_look: Callable[[], None] | None
    ) -> None:
        self.jobs, self.work, self.launcher = jobs, work, launcher
        self.on_change, self.on_look = on_change, on_look or (lambda: None)
        self.seen: dict[int, JobStatus] = {}
        self.running: list[int] = []
        """Jobs whose status may still change."""

    def run(self) -> list[JobStatus | None]:
        """Run all jobs, and those once more for which it can help."""
        write_plan(self.work, self._plan())
        with signals_as_interrupts():
            is_complete = self._run(range(len(self.jobs)), self.launcher)
            for retry, processes in ((AGAIN, self.launcher.processes), (ALONE, 1)):
                numbers = [number for number, status in sorted(self.seen.items()) if status.retry == retry]
                if is_complete and numbers:
                    is_complete = self._run(numbers, replace(self.launcher, processes=processes))
        if is_complete:
            shutil.rmtree(self.work, ignore_errors=True)
        return [self.seen.get(number) for number in range(len(self.jobs))]

    def _plan(self) -> PlannedJobs:
        """Return the content of the plan file."""
        launcher = self.launcher
        slots = launcher.processes if launcher.name == "submitit_local" else None  # it starts all jobs at once
        threads = max(1, count_cores() // launcher.processes) if launcher.shares_cores else None
        return PlannedJobs(slots, tuple(self.jobs), os.environ.get(VISIBLE_GPUS), threads)

    def _run(self, numbers: Sequence[int], launcher: Launcher) -> bool:
        """Run some of the jobs, and return whether all of them have ended."""
        self.running = list(numbers)
        processes = start_processes(self.work, numbers, launcher)
        try:
            while processes.are_running():
                self._look()
                self.on_look()
                time.sleep(_LOOK_EVERY_S)
        except BaseException as reason:
            _stop(processes, self.work)
            if isinstance(reason, KeyboardInterrupt):
                self._look()
            raise
        self._look()
        if not self.running:
            return True
        why = f"{_last_line(processes.log)}; see {processes.log}"
        if not self.seen:
            raise UserError(f"launcher={launcher.name} started no job: {why}")
        log.warning(
            "warning: launcher=%s ended before %d of %d jobs did: %s", launcher.name, len(self.running), len(numbers), why
        )
        return False

    def _look(self) -> None:
        """Read the status of the jobs that run, and tell what has changed."""
        for number in list(self.running):
            status = read_result(self.work, number)
            if status is None or status == self.seen.get(number):
                continue
            self.seen[number] = status
            if status.state != "running":
                self.running.remove(number)
            self.on_change(number, status)  # first, as it clears the terminal for a line
            if status.retry:
                when = "when no other run works" if status.retry == ALONE else "when the other runs have ended"
                log.info("%s: %s: %s; it is tried once more %s", self.jobs[number].name, status.stage, status.reason, when)


def _last_line(log_file: Path) -> str:
    lines = [line.strip() for line in log_file.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else "no output"


def _stop(processes: Processes, work: Path) -> None:
    """Ask all jobs to end and wait for them; on a second Ctrl-C, or if they cannot be asked, kill them."""
    try:
        ask_to_stop(work)
        processes.wait()
    except (KeyboardInterrupt, OSError):  # as on a full disk, where no checkpoint could be written either
        processes.kill()


def _remove_abandoned(folder: Path) -> None:
    """Delete the folders of earlier calls that no process uses any more."""
    found = [re.fullmatch(r"\.?([0-9a-f]{8})(?:\..*)?", path.name) for path in folder.iterdir()]
    for work in sorted(folder / name for name in {match[1] for match in found if match}):
        release = try_lock(lock_file(work))
        if release is None:
            continue
        is_abandoned = not may_be_in_use(work)
        if is_abandoned:
            shutil.rmtree(work, ignore_errors=True)
        release()
        if is_abandoned:
            for path in folder.glob(f".{work.name}.*"):  # its lock, and who held it
                path.unlink(missing_ok=True)
