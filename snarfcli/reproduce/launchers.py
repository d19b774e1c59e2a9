"""Processes that run jobs of a plan file: those that this program starts itself, or one that gives the jobs to Hydra."""

from __future__ import annotations

import os
import signal
import subprocess
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Protocol

from snarfcli.errors import UserError
from snarfcli.hydra_config.launchers import PLUGIN_LAUNCHERS
from snarfcli.hydra_config.overrides import quote
from snarfcli.locks import inherited_locks
from snarfcli.parallel import count_cores
from snarfcli.reproduce.failures import reason_of, retry_of
from snarfcli.reproduce.jobs import JobStatus
from snarfcli.reproduce.planned_jobs import has_results, plan_file, read_result, share_threads, write_result
from snarfcli.safe_start import safe_environment, snarf_command
from snarfcli.slots import SLOT_VARIABLE

__all__ = ["LAUNCHERS", "HydraProcess", "Launcher", "LocalProcesses", "Processes", "start_processes"]

LAUNCHERS = ("local", *PLUGIN_LAUNCHERS)
"""How jobs can be distributed: by this program on processes of this machine, or by launchers of Hydra."""

_TIME_LIMIT_MIN = 7 * 24 * 60  # the default of submitit is an hour


@dataclass(frozen=True)
class Launcher:
    """How jobs are distributed."""

    name: str = "local"
    """One of `LAUNCHERS`."""
    processes: int = 1
    """Number of jobs at a time; on a cluster the maximum."""
    threads: int | None = None
    """Threads per job, also requested from a cluster; None shares the cores out among the jobs of this machine."""
    settings: tuple[str, ...] = ()
    """Further settings of Hydra's launcher, such as partition=gpu."""

    @property
    def shares_cores(self) -> bool:
        """Whether the cores of this machine are shared out; not if the user has said how many threads a process has."""
        return self.threads is None and self.name != "submitit_slurm" and not os.environ.get("OMP_NUM_THREADS")


class Processes(Protocol):
    """Processes that run jobs."""

    log: Path
    """File with what they print, or folder with such files."""

    def are_running(self) -> bool:
        """Return whether a job runs or waits; call it regularly, since waiting jobs are started here.

        Raises:
            UserError: no job can be started.
        """
        ...

    def wait(self) -> None:
        """Wait until all running processes have ended; nothing is started any more."""
        ...

    def kill(self) -> None:
        """Kill all running processes."""
        ...


def start_processes(work: Path, numbers: Sequence[int], launcher: Launcher) -> Processes:
    """Return processes that run jobs.

    Args:
        work: folder with the plan file, and for the status of each job.
        numbers: the jobs, by their place in the plan, in the order in which they are to be started.
        launcher: how they are distributed.
    """
    return (LocalProcesses if launcher.name == "local" else HydraProcess)(work, numbers, launcher)


@dataclass(frozen=True)
class _Child:
    """A process that runs a job."""

    process: subprocess.Popen[bytes]
    slot: int
    before: JobStatus | None
    """Status of the job before this try."""
    log_begin: int
    """Where its output begins in the log of the job, bytes."""


class LocalProcesses:
    """One process, `snarf reproduce_job`, for each job; a job is started as soon as another one has ended.

    The cores are shared out among the jobs that run: one thread each if there is a process per core, which is faster than
    fewer jobs with more threads (`benchmarks/bm_threads.py`). When no job waits any more, the commands that the last ones
    start get the cores of those that have ended.
    """

    def __init__(self, work: Path, numbers: Iterable[int], launcher: Launcher) -> None:
        self.log = work
        self._work, self._launcher = work, launcher
        self._waiting = deque(numbers)
        self._running: dict[int, _Child] = {}  # in the order of their start
        self._shares: dict[int, int] = {}

    def are_running(self) -> bool:
        for number, child in list(self._running.items()):
            code = child.process.poll()
            if code is not None:
                del self._running[number]
                self._check_end(number, code, child)
        starting = [self._waiting.popleft() for _ in range(self._launcher.processes - len(self._running)) if self._waiting]
        if self._launcher.shares_cores:
            self._share_cores([*self._running, *starting])
        for number in starting:
            self._running[number] = self._start(number)
        return bool(self._running)

    def wait(self) -> None:
        for child in self._running.values():
            child.process.wait()

    def kill(self) -> None:
        for child in self._running.values():
            _kill_group(child.process)

    def _share_cores(self, numbers: Sequence[int]) -> None:
        """Share the cores out among jobs; those that began first get what is left over."""
        each, left = divmod(count_cores(), max(1, len(numbers)))
        shares = {number: max(1, each + (place < left)) for place, number in enumerate(numbers)}
        if shares != self._shares:
            share_threads(self._work, shares)
            self._shares = shares

    def _start(self, number: int) -> _Child:
        used = {child.slot for child in self._running.values()}
        slot = next(slot for slot in count() if slot not in used)
        arguments = ["reproduce_job", f"plan={quote(str(plan_file(self._work)))}", f"job={number}"]
        before, log = read_result(self._work, number), self._log_of(number)
        log_begin = log.stat().st_size if log.exists() else 0
        return _Child(_start(arguments, log, {SLOT_VARIABLE: str(slot)}), slot, before, log_begin)

    def _log_of(self, number: int) -> Path:
        return self._work / f"{number}.log"

    def _check_end(self, number: int, code: int, child: _Child) -> None:
        """Record a failure if the process of a job has ended without the job's final status."""
        status, before = read_result(self._work, number), child.before
        if status is not None and status.state != "running" and status != before:
            return
        log = self._log_of(number)
        reason = reason_of(log, child.log_begin, code)
        retry = retry_of(code, reason)
        if not (retry or has_results(self._work)):
            raise UserError(f"launcher=local started no job: {reason}; see {log}")
        tries = 1 if before is None else before.tries + 1
        status = JobStatus("failed", stage="reproduce", reason=reason, tries=tries, retry=retry if tries == 1 else "")
        write_result(self._work, number, status)


class HydraProcess:
    """One process that gives all jobs to a launcher of Hydra: `snarf reproduce_job -m job=0,1,2 hydra/launcher=...`."""

    def __init__(self, work: Path, numbers: Sequence[int], launcher: Launcher) -> None:
        self.log = work / "launcher.log"
        self._process = _start(_hydra_arguments(work, numbers, launcher), self.log)

    def are_running(self) -> bool:
        return self._process.poll() is None

    def wait(self) -> None:
        self._process.wait()

    def kill(self) -> None:
        _kill_group(self._process)


def _start(arguments: Sequence[str], log: Path, more: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
    """Start `snarf` in a session of its own, so that Ctrl-C does not reach it, with its output in a file.

    Args:
        arguments: of `snarf`.
        log: the file; the output is appended.
        more: environment variables; those that are set already stay.
    """
    with log.open("a") as file:
        return subprocess.Popen(
            snarf_command(arguments), env={**(more or {}), **safe_environment()},
            stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
            pass_fds=inherited_locks(),
        )  # fmt: skip


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill a process that `_start` has started, and those that it has started."""
    if process.poll() is not None:
        return
    if os.name == "posix":
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


def _hydra_arguments(work: Path, numbers: Sequence[int], launcher: Launcher) -> list[str]:
    """Return the arguments of `snarf` that give the jobs to Hydra's launcher."""
    arguments = ["reproduce_job", f"plan={quote(str(plan_file(work)))}", f"job={','.join(map(str, numbers))}", "-m"]
    arguments.append(f"hydra/launcher={launcher.name}")
    settings = {"hydra.sweep.dir": quote(str(work / "launcher"))}
    if launcher.name == "joblib":
        settings["hydra.launcher.n_jobs"] = str(launcher.processes)
    if launcher.name.startswith("submitit"):
        settings["hydra.launcher.timeout_min"] = str(_TIME_LIMIT_MIN)
        if launcher.threads:
            settings["hydra.launcher.cpus_per_task"] = str(launcher.threads)
    if launcher.name == "submitit_slurm":
        settings["hydra.launcher.array_parallelism"] = str(launcher.processes)
    settings |= {f"hydra.launcher.{name}": value for name, _, value in (one.partition("=") for one in launcher.settings)}
    return arguments + [f"{name}={value}" for name, value in settings.items()]
