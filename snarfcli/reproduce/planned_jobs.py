"""The plan file of a call, and one job of it: how `snarf reproduce_job` runs it and tells what has become of it.

DESIGN. The plan is a file on a disk that all machines see. Every job writes its status beside the plan, and looks there for
a file that asks it to stop. So a job can run in a process of this machine, in a worker of joblib or on another machine of a
cluster, and Ctrl-C reaches all of them: each lets its command write a checkpoint and ends.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json
from snarfcli.locks import hold_slot
from snarfcli.output_locks import holder_is_gone
from snarfcli.reproduce.failures import retry_of_error
from snarfcli.reproduce.jobs import JobStatus, read_job_status, run_job
from snarfcli.reproduce.plans import Job
from snarfcli.slots import use_slot
from snarfcli.texts import one_line

__all__ = [
    "VISIBLE_GPUS",
    "PlannedJobs",
    "ask_to_stop",
    "has_results",
    "plan_file",
    "read_planned_job",
    "read_result",
    "run_planned_job",
    "share_threads",
    "write_plan",
    "write_result",
]

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
"""Environment variable that hides GPUs from CUDA."""

_MOST_SLOTS = 10_000
_STOP = "stop"
_THREADS = "threads.json"


@dataclass(frozen=True)
class PlannedJobs:
    """Content of a plan file."""

    slots: int | None
    """How many jobs may run at a time; None where the launcher sees to it."""
    jobs: tuple[Job, ...]
    """All jobs."""
    visible_gpus: str | None = None
    """CUDA_VISIBLE_DEVICES of the call; None if it was not set."""
    threads: int | None = None
    """Threads of the commands that do not name a number, where `share_threads` has not said otherwise."""


def plan_file(work: Path) -> Path:
    """Return the plan file of a call whose files are in the folder `work`."""
    return work / "plan.json"


def write_plan(work: Path, plan: PlannedJobs) -> None:
    """Write the plan file of a call."""
    write_json(plan_file(work), asdict(plan))


def read_result(work: Path, number: int) -> JobStatus | None:
    """Return the status of a job; None before it has one, and while a network drive replaces the file."""
    with contextlib.suppress(OSError):
        return read_job_status(_result(work, number))
    return None


def has_results(work: Path) -> bool:
    """Return whether any job of a call has a status."""
    return any(work.glob("[0-9]*.json"))


def write_result(work: Path, number: int, status: JobStatus) -> None:
    """Write the status of a job, for the call that waits for it."""
    write_json(_result(work, number), asdict(status))


def share_threads(work: Path, threads: Mapping[int, int]) -> None:
    """Give jobs, by number, their threads; each command that a job starts from now on gets that many."""
    write_json(work / _THREADS, {str(number): count for number, count in threads.items()})


def ask_to_stop(work: Path) -> None:
    """Ask all jobs of a call to end; each lets its command write a checkpoint."""
    (work / _STOP).touch()


def run_planned_job(plan: Path, number: int) -> None:
    """Run one job of the plan in a file, and write its status beside the file.

    Raises:
        UserError: the plan or the job does not exist.
    """
    job, planned = read_planned_job(plan, number)
    work = plan.parent
    before = read_result(work, number)
    tries = 1 if before is None else before.tries + 1

    def stopped() -> bool:
        return (work / _STOP).exists() or holder_is_gone(work)

    def begin() -> JobStatus:
        if not stopped():
            write_result(work, number, JobStatus("running", job.digest, tries=tries))
        return run_job(job, stopped=stopped, threads=lambda: _threads(work, number, planned.threads), tries=tries)

    try:
        if planned.slots is None:
            status = begin()
        else:
            with hold_slot(work, planned.slots) as slot, use_slot(slot), _see_gpus(planned.visible_gpus):
                status = begin()
    except Exception as error:  # a fault of the program or a full disk; the other jobs still run
        reason, retry = f"{type(error).__name__}: {one_line(error)}", retry_of_error(error) if tries == 1 else ""
        status = JobStatus("failed", job.digest, stage="reproduce", reason=reason, tries=tries, retry=retry)
    write_result(work, number, status)


def read_planned_job(plan: Path, number: int) -> tuple[Job, PlannedJobs]:
    """Return a job of the plan in a file, and the plan.

    Raises:
        UserError: the plan or the job does not exist, or the plan is damaged.
    """
    try:
        content = read_described(PlannedJobs, read_json(plan, "plan"), "plan", ignore_unknown=True)
    except DescriptionError as error:
        raise UserError(f"plan {plan} is damaged ({error}); use a plan that snarf reproduce has written") from None
    if not 0 <= number < len(content.jobs) or (content.slots is not None and not 0 < content.slots <= _MOST_SLOTS):
        raise UserError(f"plan {plan} has no job {number}; use a plan that snarf reproduce has written")
    return content.jobs[number], content


def _result(work: Path, number: int) -> Path:
    return work / f"{number}.json"


def _threads(work: Path, number: int, usual: int | None) -> int | None:
    """Return the threads for the next command of a job."""
    try:
        shares = read_json(work / _THREADS)
    except (UserError, OSError):
        return usual
    threads = shares.get(str(number)) if isinstance(shares, dict) else None
    return threads if type(threads) is int and threads > 0 else usual


@contextlib.contextmanager
def _see_gpus(visible: str | None) -> Iterator[None]:
    """Set CUDA_VISIBLE_DEVICES, or remove it if `visible` is None, while the block runs.

    submitit hides all GPUs from the jobs that it starts on this machine, unless it is told how many each of them needs.
    """
    before = os.environ.pop(VISIBLE_GPUS, None)
    os.environ.update({} if visible is None else {VISIBLE_GPUS: visible})
    try:
        yield
    finally:
        os.environ.pop(VISIBLE_GPUS, None)
        os.environ.update({} if before is None else {VISIBLE_GPUS: before})
