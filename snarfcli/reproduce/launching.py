"""Run the jobs of a plan in parallel with Hydra's launchers, and watch their status.

DESIGN. The plan is a file on a disk that all machines see. A child process, `snarf reproduce_job -m job=0,1,2
hydra/launcher=...`, gives its jobs to the launcher. Every job writes its status beside the plan, and looks there for a file
that asks it to stop. So a job can run in the child process, in a worker of joblib or on another machine of a cluster, and
Ctrl-C reaches all of them: each lets its command write a checkpoint and ends.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import re
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json
from snarfcli.hydra_config.overrides import quote
from snarfcli.interrupts import signals_as_interrupts
from snarfcli.locks import hold_slot, inherited_locks, try_lock
from snarfcli.output_locks import hold_output, holder_is_gone, lock_file, may_be_in_use
from snarfcli.reproduce.jobs import JobStatus, read_job_status, run_job
from snarfcli.reproduce.plans import Job
from snarfcli.safe_start import safe_environment, snarf_command
from snarfcli.slots import use_slot
from snarfcli.texts import one_line

__all__ = [
    "LAUNCHERS",
    "Launcher",
    "PlannedJobs",
    "check_launcher",
    "is_installed",
    "launch",
    "read_planned_job",
    "run_planned_job",
]

log = logging.getLogger(__name__)

LAUNCHERS = ("basic", "joblib", "submitit_local", "submitit_slurm")
"""How jobs can be distributed: one after the other, on processes (joblib), by submitit on this machine or on a cluster."""

_PACKAGES = {"joblib": "joblib", "submitit_local": "submitit", "submitit_slurm": "submitit"}
_LOOK_EVERY_S = 0.5
_MOST_SLOTS = 10_000
_VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
_TIME_LIMIT_MIN = 7 * 24 * 60  # the default of submitit is an hour


@dataclass(frozen=True)
class PlannedJobs:
    """Content of a plan file."""

    slots: int | None
    """How many jobs may run at a time; None where the launcher sees to it."""
    jobs: tuple[Job, ...]
    """All jobs."""
    visible_gpus: str | None = None
    """CUDA_VISIBLE_DEVICES of the call; None if it was not set."""


@dataclass(frozen=True)
class Launcher:
    """How jobs are distributed."""

    name: str = "basic"
    """One of `LAUNCHERS`."""
    processes: int = 1
    """Number of jobs at a time; on a cluster the maximum."""
    threads: int | None = None
    """Threads per job, requested from a cluster."""
    settings: tuple[str, ...] = ()
    """Further settings of Hydra's launcher, such as partition=gpu."""


def check_launcher(launcher: Launcher) -> None:
    """Check that a launcher is installed and can run the wanted number of processes.

    Raises:
        UserError: it is not installed, or it runs one job at a time and more are wanted.
    """
    package = _PACKAGES.get(launcher.name)
    if package and not is_installed(package):
        raise UserError(
            f"launcher={launcher.name} needs hydra-{package}-launcher; install it with: pip install 'snarf[{package}]' "
            f"(or pip install hydra-{package}-launcher)"
        )
    if launcher.name == "basic" and launcher.processes > 1:
        raise UserError(f"processes: wanted 1 with launcher=basic, got {launcher.processes}; give launcher=joblib too")


def is_installed(package: str) -> bool:
    """Return whether Hydra's launcher joblib or submitit is installed."""
    try:
        return importlib.util.find_spec(f"hydra_plugins.hydra_{package}_launcher") is not None
    except ModuleNotFoundError:  # no Hydra plugin is installed
        return False


def launch(
    jobs: Sequence[Job], folder: Path, launcher: Launcher, on_change: Callable[[int, JobStatus], None]
) -> list[JobStatus | None]:
    """Run jobs and return the status of each; None for a job that the launcher has not started.

    On Ctrl-C (or SIGTERM, SIGHUP) every running command writes its checkpoint; a second Ctrl-C kills all processes. If this
    process is killed, the jobs notice it and end likewise.

    Args:
        jobs: the jobs.
        folder: for the plan and the files of the launcher.
        launcher: how the jobs are distributed.
        on_change: called with the number of a job and its status when it starts and when it ends.

    Raises:
        UserError: the launcher has not started any job.
        KeyboardInterrupt: interrupted; all processes have ended.
    """
    work = folder / secrets.token_hex(4)
    with hold_output(work, "snarf reproduce"):
        _remove_abandoned(folder)
        work.mkdir(parents=True)
        statuses = _launch(jobs, work, launcher, on_change)
    with contextlib.suppress(OSError):  # other calls have files there
        folder.rmdir()
    return statuses


def _launch(
    jobs: Sequence[Job], work: Path, launcher: Launcher, on_change: Callable[[int, JobStatus], None]
) -> list[JobStatus | None]:
    """Run jobs with their files in the folder `work`, which is deleted when all have ended as planned; see `launch`."""
    plan = PlannedJobs(_slots(launcher), tuple(jobs), os.environ.get(_VISIBLE_GPUS))
    write_json(work / "plan.json", asdict(plan))
    said = work / "launcher.log"
    with said.open("w") as file:
        process = subprocess.Popen(
            snarf_command(_arguments(work, len(jobs), launcher)), env=safe_environment(),
            stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
            pass_fds=inherited_locks(),
        )  # fmt: skip
    seen: dict[int, JobStatus] = {}

    def look() -> None:
        for number in range(len(jobs)):
            if number not in seen or seen[number].state == "running":
                status = _read(work / f"{number}.json")
                if status is not None and status != seen.get(number):
                    seen[number] = status
                    on_change(number, status)

    with signals_as_interrupts():
        try:
            while process.poll() is None:
                look()
                time.sleep(_LOOK_EVERY_S)
        except BaseException as reason:
            _stop(process, work)
            if isinstance(reason, KeyboardInterrupt):
                look()
            raise
    look()
    left = [number for number in range(len(jobs)) if number not in seen or seen[number].state == "running"]
    if left:
        lines = [line.strip() for line in said.read_text(errors="replace").splitlines() if line.strip()]
        why = f"{lines[-1] if lines else 'no output'}; see {said}"
        if not seen:
            raise UserError(f"launcher={launcher.name} started no job: {why}")
        log.warning("warning: launcher=%s ended before %d of %d jobs did: %s", launcher.name, len(left), len(jobs), why)
    if not left:
        shutil.rmtree(work, ignore_errors=True)
    return [seen.get(number) for number in range(len(jobs))]


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


def run_planned_job(plan: Path, number: int) -> None:
    """Run one job of the plan in a file, and write its status beside the file.

    Raises:
        UserError: the plan or the job does not exist.
    """
    job, planned = read_planned_job(plan, number)
    result, stop = plan.with_name(f"{number}.json"), plan.with_name("stop")

    def stopped() -> bool:
        return stop.exists() or holder_is_gone(plan.parent)

    def begin() -> JobStatus:
        if not stopped():
            write_json(result, asdict(JobStatus("running", job.digest)))
        return run_job(job, stopped=stopped)

    try:
        if planned.slots is None:
            status = begin()
        else:
            with hold_slot(plan.parent, planned.slots) as slot, use_slot(slot), _see_gpus(planned.visible_gpus):
                status = begin()
    except Exception as error:  # a fault of the program or a full disk; the other jobs still run
        status = JobStatus("failed", job.digest, stage="reproduce", reason=f"{type(error).__name__}: {one_line(error)}")
    write_json(result, asdict(status))


@contextlib.contextmanager
def _see_gpus(visible: str | None) -> Iterator[None]:
    """Set CUDA_VISIBLE_DEVICES, or remove it if `visible` is None, while the block runs.

    submitit hides all GPUs from the jobs that it starts on this machine, unless it is told how many each of them needs.
    """
    before = os.environ.pop(_VISIBLE_GPUS, None)
    os.environ.update({} if visible is None else {_VISIBLE_GPUS: visible})
    try:
        yield
    finally:
        os.environ.pop(_VISIBLE_GPUS, None)
        os.environ.update({} if before is None else {_VISIBLE_GPUS: before})


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


def _arguments(work: Path, count: int, launcher: Launcher) -> list[str]:
    """Return the arguments of `snarf` that give the jobs to Hydra's launcher."""
    arguments = ["reproduce_job", f"plan={quote(str(work / 'plan.json'))}", f"job={','.join(map(str, range(count)))}"]
    arguments += ["-m"] if count > 1 or launcher.name != "basic" else []
    settings = {"hydra.sweep.dir": quote(str(work / "launcher"))}
    if launcher.name != "basic":
        arguments.append(f"hydra/launcher={launcher.name}")
    if launcher.name == "joblib":
        settings |= {"hydra.launcher.n_jobs": str(launcher.processes)}
    if launcher.name.startswith("submitit"):
        settings |= {"hydra.launcher.timeout_min": str(_TIME_LIMIT_MIN)}
        if launcher.threads:
            settings["hydra.launcher.cpus_per_task"] = str(launcher.threads)
    if launcher.name == "submitit_slurm":
        settings["hydra.launcher.array_parallelism"] = str(launcher.processes)
    settings |= {f"hydra.launcher.{name}": value for name, _, value in (one.partition("=") for one in launcher.settings)}
    return arguments + [f"{name}={value}" for name, value in settings.items()]


def _slots(launcher: Launcher) -> int | None:
    """Return the maximum number of jobs at a time for a launcher that starts all of them, None for the others."""
    return launcher.processes if launcher.name == "submitit_local" else None


def _read(path: Path) -> JobStatus | None:
    with contextlib.suppress(OSError):  # on a network drive, while it is replaced
        return read_job_status(path)
    return None


def _stop(process: subprocess.Popen[Any], work: Path) -> None:
    """Ask all jobs to end and wait for them; on a second Ctrl-C kill them."""
    (work / "stop").touch()
    try:
        process.wait()
    except KeyboardInterrupt:
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
        process.wait()
