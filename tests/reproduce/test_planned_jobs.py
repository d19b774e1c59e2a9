"""One job of a plan file: its status, its tries, its threads and its GPU."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from fake_runs import fake_plan

from snarfcli.errors import UserError
from snarfcli.files import write_json
from snarfcli.locks import hold_slot, locked
from snarfcli.reproduce import planned_jobs
from snarfcli.reproduce.jobs import JobStatus
from snarfcli.reproduce.planned_jobs import PlannedJobs, read_result, run_planned_job, share_threads, write_plan
from snarfcli.safe_start import safe_environment
from snarfcli.slots import current_slot, use_slot


@pytest.fixture
def jobs(tmp_path):
    return tuple(fake_plan(tmp_path, systems=("snarf", "nasa")).jobs)


def test_waiting_jobs_get_a_slot_when_they_start_and_see_the_gpus_of_the_call(jobs, tmp_path, monkeypatch):
    """submitit starts all jobs at once, and sets CUDA_VISIBLE_DEVICES to nothing on this machine."""
    seen = []

    def run_job(job, **more):
        seen.append((current_slot(), os.environ.get("CUDA_VISIBLE_DEVICES")))
        return JobStatus("done", job.digest)

    monkeypatch.setattr(planned_jobs, "run_job", run_job)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    for visible in ("2,5", None):
        write_plan(tmp_path, PlannedJobs(3, jobs, visible))
        with hold_slot(tmp_path):
            run_planned_job(tmp_path / "plan.json", 0)
    assert seen == [(1, "2,5"), (1, None)]
    assert os.environ["CUDA_VISIBLE_DEVICES"] == ""

    write_plan(tmp_path, PlannedJobs(None, jobs, "2,5"))
    with use_slot(4):  # of a launcher that starts a job when it can run, or of a cluster, which assigns GPUs itself
        run_planned_job(tmp_path / "plan.json", 0)
    assert seen[2:] == [(4, "")]


def test_threads_follow_the_shares_of_the_call_while_a_job_runs(jobs, tmp_path, monkeypatch):
    seen = []

    def run_job(job, *, threads, **more):
        seen.append(threads())
        share_threads(tmp_path, {0: 1, 1: 3})
        seen.append(threads())
        share_threads(tmp_path, {0: 4})
        seen.append(threads())
        (tmp_path / "threads.json").write_text("{")  # damaged
        seen.append(threads())
        return JobStatus("done", job.digest)

    monkeypatch.setattr(planned_jobs, "run_job", run_job)
    write_plan(tmp_path, PlannedJobs(None, jobs, threads=2))
    run_planned_job(tmp_path / "plan.json", 1)
    assert seen == [2, 3, 2, 2]


def test_tries_are_counted_and_errors_of_the_program_recorded(jobs, tmp_path, monkeypatch):
    def run_job(job, *, tries, **more):
        assert read_result(tmp_path, 0) == JobStatus("running", job.digest, tries=tries)
        raise MemoryError("too small a machine")

    monkeypatch.setattr(planned_jobs, "run_job", run_job)
    write_plan(tmp_path, PlannedJobs(None, jobs))
    told = []
    for _ in range(2):
        run_planned_job(tmp_path / "plan.json", 0)
        told.append(read_result(tmp_path, 0))
    wanted = JobStatus("failed", jobs[0].digest, stage="reproduce", reason="MemoryError: too small a machine", retry="alone")
    assert told == [wanted, JobStatus(**(asdict(wanted) | {"tries": 2, "retry": ""}))]


@pytest.mark.skipif(os.name != "posix", reason="whether the call lives is only known on Unix")
def test_a_job_whose_call_is_killed_ends(jobs, tmp_path):
    work = tmp_path / "jobs" / "0123abcd"
    work.mkdir(parents=True)
    write_plan(work, PlannedJobs(None, jobs))
    code = (
        "import pathlib, subprocess, sys, time\nfrom snarfcli.output_locks import hold_output\n"
        "from snarfcli.safe_start import snarf_command\nwork = pathlib.Path(sys.argv[1])\n"
        "with hold_output(work, 'snarf reproduce'):\n"
        "    subprocess.Popen(snarf_command(['reproduce_job', f'plan={work}/plan.json', 'job=0']), start_new_session=True)\n"
        "    time.sleep(600)\n"
    )
    with locked(Path(jobs[0].folder) / ".reproduce.lock"):  # so that the job waits
        call = subprocess.Popen([sys.executable, "-c", code, str(work)], env=safe_environment())
        wait_for(work, "running")
        call.kill()
        call.wait()
        assert wait_for(work, "stopped").digest == jobs[0].digest


def wait_for(work: Path, state: str) -> JobStatus:
    """Wait until job 0 has a state, and return its status."""
    for _ in range(6000):
        status = read_result(work, 0)
        if status is not None and status.state == state:
            return status
        time.sleep(0.02)
    raise AssertionError(f"job 0 is not {state}: {read_result(work, 0)}")


def test_a_job_that_is_not_in_the_plan_is_rejected(tmp_path):
    with pytest.raises(UserError, match="no plan at"):
        run_planned_job(tmp_path / "plan.json", 0)
    write_json(tmp_path / "plan.json", {"jobs": [], "slots": None})
    with pytest.raises(UserError, match="has no job 3"):
        run_planned_job(tmp_path / "plan.json", 3)
