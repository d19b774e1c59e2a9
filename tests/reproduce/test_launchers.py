"""Processes that run jobs: how many at a time, in which order, on which GPU and with how many threads."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any, cast

import pytest
from fake_jobs import FakeJobs

from snarfcli.errors import UserError
from snarfcli.files import read_json
from snarfcli.reproduce import launchers
from snarfcli.reproduce.jobs import JobStatus
from snarfcli.reproduce.launchers import Launcher, LocalProcesses
from snarfcli.reproduce.planned_jobs import read_result, write_result


@pytest.fixture
def work(tmp_path):
    folder = tmp_path / "work"
    folder.mkdir()
    return folder


@pytest.fixture(autouse=True)
def four_cores(monkeypatch):
    monkeypatch.setattr(launchers, "count_cores", lambda: 4)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("SNARF_GPU_SLOT", raising=False)


def run(work: Path, count: int, launcher: Launcher) -> None:
    processes = LocalProcesses(work, range(count), launcher)
    while processes.are_running():
        time.sleep(0.02)


def states(work: Path, count: int) -> list[str | None]:
    statuses = [read_result(work, number) for number in range(count)]
    return [status and status.state for status in statuses]


def test_a_job_begins_as_soon_as_another_one_has_ended_on_the_gpu_that_is_free(work, tmp_path, monkeypatch):
    # Job 0 ends after job 3: so while it runs, the second process does one job after the other.
    fake = FakeJobs(tmp_path, monkeypatch, {0: ["after 3"], 1: ["done"], 2: ["done"], 3: ["done"], 4: ["done"]})
    run(work, 5, Launcher(processes=2))
    assert states(work, 5) == ["done"] * 5
    slots = {number: slot for number, event, slot, _ in fake.events() if event == "start"}
    assert slots[0] == "0"
    assert {slots[1], slots[2], slots[3]} == {"1"}
    running, most = set(), 0
    for number, event, _, _ in fake.events():
        running = running | {number} if event == "start" else running - {number}
        most = max(most, len(running))
    assert most == 2
    assert [number for number in fake.started() if number > 1] == [2, 3, 4]


def test_a_gpu_that_the_user_has_given_stays(work, tmp_path, monkeypatch):
    monkeypatch.setenv("SNARF_GPU_SLOT", "5")
    fake = FakeJobs(tmp_path, monkeypatch, {0: ["after 1"], 1: ["done"]})
    run(work, 2, Launcher(processes=2))
    assert {slot for _, _, slot, _ in fake.events()} == {"5"}


def test_cores_are_shared_out_among_the_jobs_that_run(work, tmp_path, monkeypatch):
    fake = FakeJobs(tmp_path, monkeypatch, {0: ["after 1"], 1: ["after 2"], 2: ["meet 0 1"]})
    run(work, 3, Launcher(processes=3))
    begun = {number: threads for number, event, _, threads in fake.events() if event == "start"}
    assert begun == {0: 2, 1: 1, 2: 1}, "no core is idle"
    processes = LocalProcesses(work, [], Launcher())
    for numbers, wanted in (((1,), [4]), ((0, 1), [2, 2]), ((1, 2, 3, 4), [1] * 4), (range(6), [1] * 6)):
        processes._share_cores(numbers)
        assert read_json(work / "threads.json") == dict(zip(map(str, numbers), wanted, strict=True))


@pytest.mark.parametrize("given", ["threads", "environment"])
def test_a_number_of_threads_that_the_user_has_given_stays(work, tmp_path, monkeypatch, given):
    if given == "environment":
        monkeypatch.setenv("OMP_NUM_THREADS", "3")
    fake = FakeJobs(tmp_path, monkeypatch, {0: ["done"]})
    run(work, 1, Launcher(threads=3 if given == "threads" else None))
    assert [threads for _, _, _, threads in fake.events()] == [None, None]


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_a_job_whose_process_is_killed_is_a_failure_and_the_others_run(work, tmp_path, monkeypatch):
    FakeJobs(tmp_path, monkeypatch, {0: ["done"], 1: ["signal SIGKILL"], 2: ["signal SIGTERM"], 3: ["break"], 4: ["done"]})
    run(work, 5, Launcher())
    assert states(work, 5) == ["done", "failed", "failed", "failed", "done"]
    told = [read_result(work, number) for number in (1, 2, 3)]
    assert [(status.stage, status.reason, status.retry) for status in told] == [
        ("reproduce", "ended by SIGKILL (out of memory?)", "alone"),
        ("reproduce", "ended by SIGTERM", ""),
        ("reproduce", "cannot start", ""),
    ]


def test_if_no_job_can_begin_the_first_one_says_why(work, tmp_path, monkeypatch):
    fake = FakeJobs(tmp_path, monkeypatch, {number: ["break"] for number in range(9)})
    with pytest.raises(UserError, match=r"launcher=local started no job: cannot start; see .*0\.log"):
        run(work, 9, Launcher())
    assert fake.started() == [0]


def test_a_try_that_says_nothing_does_not_get_the_reason_of_the_one_before(work):
    log, before = work / "0.log", JobStatus("failed", retry="again")
    log.write_text("snarf reproduce_job: old\n")
    write_result(work, 0, before)
    child = launchers._Child(cast(Any, None), 0, before, log.stat().st_size)
    LocalProcesses(work, [], Launcher())._check_end(0, 3, child)
    status = read_result(work, 0)
    assert status is not None
    assert (status.reason, status.tries) == ("exit code 3", 2)


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc whether a process works")
def test_killing_reaches_the_commands_of_a_job(work, tmp_path, monkeypatch):
    fake = FakeJobs(tmp_path, monkeypatch, {0: ["hang"], 1: ["stop"]})
    processes = LocalProcesses(work, range(2), Launcher(processes=2))
    while processes.are_running() and (len(fake.hanging()) < 2 or states(work, 2)[1] != "running"):
        time.sleep(0.02)
    assert os.getpgid(fake.hanging()[0]) != os.getpgrp(), "Ctrl-C of the terminal does not reach jobs"
    processes.kill()
    processes.wait()
    for pid in fake.hanging():
        assert not is_alive(pid)


def is_alive(pid: int) -> bool:
    """Return whether a process works; one that has ended but was not waited for does not."""
    for _ in range(100):  # init waits for it soon
        try:
            os.kill(pid, 0)
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (ProcessLookupError, FileNotFoundError):
            return False
        if state == "Z":
            return False
        time.sleep(0.02)
    return True


def test_settings_reach_hydra(tmp_path):
    def arguments(launcher: Launcher, numbers=(0, 1, 2)) -> list[str]:
        return launchers._hydra_arguments(tmp_path, numbers, launcher)

    slurm = arguments(Launcher("submitit_slurm", 8, 4, ("partition=gpu", "timeout_min=60")))
    assert {"job=0,1,2", "-m", "hydra/launcher=submitit_slurm", "hydra.launcher.partition=gpu"} <= set(slurm)
    assert {"hydra.launcher.array_parallelism=8", "hydra.launcher.cpus_per_task=4"} <= set(slurm)
    assert "hydra.launcher.timeout_min=60" in slurm
    assert len([a for a in slurm if "timeout_min" in a]) == 1
    assert {"hydra.launcher.n_jobs=2", "job=3", "-m"} <= set(arguments(Launcher("joblib", 2), (3,)))
