"""Hydra's launchers run the jobs of a plan and return their status."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from fake_runs import fake_plan, fake_run

from snarfcli.errors import UserError
from snarfcli.files import write_json
from snarfcli.locks import hold_slot
from snarfcli.reproduce import launching
from snarfcli.reproduce.jobs import JobStatus
from snarfcli.reproduce.launching import Launcher, PlannedJobs, check_launcher, launch, run_planned_job
from snarfcli.slots import current_slot, use_slot


@pytest.mark.parametrize("name", ["basic", "joblib"])
def test_a_launcher_brings_every_job_to_its_end(name, tmp_path, monkeypatch):
    if name != "basic" and not launching.is_installed(name):
        pytest.skip(f"hydra-{name}-launcher is not installed")
    monkeypatch.chdir(tmp_path)
    jobs = fake_plan(tmp_path, systems=("snarf", "nasa")).jobs
    for job in jobs:  # all results exist, so that only the launcher is tested
        fake_run(job, {"id": 0.9, "ood": 0.8})
    seen = []
    processes = 2 if name == "joblib" else 1
    statuses = launch(jobs, tmp_path / "work", Launcher(name, processes), lambda *change: seen.append(change))
    said = [path.read_text() for path in tmp_path.glob("work/*/launcher.log")]
    assert [status and status.state for status in statuses] == ["done", "done"], (statuses, said)
    assert {number for number, status in seen if status.state == "done"} == {0, 1}
    assert len(seen) <= 4
    assert {path.name for path in tmp_path.iterdir()} == {"data", "outputs"}, "nothing is left behind"


def test_a_launcher_that_does_not_start_is_an_error(tmp_path, monkeypatch):
    jobs = fake_plan(tmp_path, systems=("snarf",)).jobs
    monkeypatch.setattr(launching, "_arguments", lambda *_: ["reproduce_job", "plan=none.json", "job=0"])
    with pytest.raises(UserError, match=r"launcher=basic started no job: .*no plan at .*none.json; see"):
        launch(jobs, tmp_path / "work", Launcher(), lambda *_: None)


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_ctrl_c_stops_jobs_and_waits_for_them(tmp_path, monkeypatch):
    jobs = fake_plan(tmp_path, systems=("snarf",)).jobs
    # a launcher that reports a running job and waits for the sign to stop, as the job does
    code = "import pathlib, sys, time\nwork = pathlib.Path(sys.argv[1])\n(work / '0.json').write_text(sys.argv[2])\n"
    code += "while not (work / 'stop').exists(): time.sleep(0.05)\n(work / 'ended').touch()\n"
    running = json.dumps(asdict(JobStatus("running", jobs[0].digest)))
    original = subprocess.Popen

    def popen(command, **more):
        (work,) = (tmp_path / "work").glob("[!.]*")
        return original([sys.executable, "-c", code, str(work), running], **more)

    monkeypatch.setattr(subprocess, "Popen", popen)

    def interrupt(number: int, status: JobStatus) -> None:
        os.kill(os.getpid(), signal.SIGTERM)  # handled as Ctrl-C is

    with pytest.raises(KeyboardInterrupt):
        launch(jobs, tmp_path / "work", Launcher(), interrupt)
    assert list(tmp_path.glob("work/*/ended")), "it was waited for"
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.skipif(os.name != "posix", reason="whether a holder lives is only known on Unix")
def test_only_what_earlier_calls_have_left_is_deleted(tmp_path):
    host, ended = socket.gethostname(), subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for name, pid, of_host in (
        ("00000000", None, ""),  # ended
        ("11111111", ended.pid, host),  # killed
        ("22222222", os.getpid(), host),  # runs, on a file system without locks
        ("33333333", 1, "elsewhere"),  # may run on another machine
        ("mine", None, ""),  # not of this program
    ):
        (tmp_path / name).mkdir()
        if pid is not None:
            about = {"command": "snarf reproduce", "pid": pid, "host": of_host, "since": ""}
            (tmp_path / f".{name}.holder.json").write_text(json.dumps(about))
    (tmp_path / "notes").touch()
    launching._remove_abandoned(tmp_path)
    left = {"22222222", ".22222222.holder.json", "33333333", ".33333333.holder.json", "mine", "notes"}
    assert {path.name for path in tmp_path.iterdir()} == left


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_jobs_do_not_outlive_an_error_of_the_call(tmp_path, monkeypatch):
    jobs = fake_plan(tmp_path, systems=("snarf",)).jobs
    original = subprocess.Popen
    code = "import pathlib, sys, time\nwork = pathlib.Path(sys.argv[1])\n"
    code += "while not (work / 'stop').exists(): time.sleep(0.05)\n(work / 'ended').touch()\n"

    def popen(command, **more):
        (work,) = (tmp_path / "work").glob("[!.]*")
        return original([sys.executable, "-c", code, str(work)], **more)

    def fail(path):
        raise MemoryError

    monkeypatch.setattr(subprocess, "Popen", popen)
    monkeypatch.setattr(launching, "_read", fail)
    with pytest.raises(MemoryError):
        launch(jobs, tmp_path / "work", Launcher(), lambda *_: None)
    assert list(tmp_path.glob("work/*/ended")), "it was waited for"


@pytest.mark.parametrize("any_plugin", [True, False])
def test_launchers_that_are_not_installed_name_what_to_install(monkeypatch, any_plugin):
    def find_spec(name):
        if not any_plugin:  # as importlib does if the parent package is missing too
            raise ModuleNotFoundError(f"No module named {name.partition('.')[0]!r}")

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    check_launcher(Launcher())
    with pytest.raises(UserError, match=r"needs hydra-joblib-launcher; install it with: pip install 'snarf\[joblib\]'"):
        check_launcher(Launcher("joblib", 2))
    with pytest.raises(UserError, match=r"pip install 'snarf\[submitit\]'"):
        check_launcher(Launcher("submitit_slurm"))
    with pytest.raises(UserError, match="processes: wanted 1 with launcher=basic, got 2; give launcher=joblib"):
        check_launcher(Launcher("basic", 2))


def test_settings_reach_hydra(tmp_path):
    arguments = launching._arguments(tmp_path, 3, Launcher("submitit_slurm", 8, 4, ("partition=gpu", "timeout_min=60")))
    assert {"job=0,1,2", "-m", "hydra/launcher=submitit_slurm", "hydra.launcher.partition=gpu"} <= set(arguments)
    assert {"hydra.launcher.array_parallelism=8", "hydra.launcher.cpus_per_task=4"} <= set(arguments)
    assert "hydra.launcher.timeout_min=60" in arguments
    assert len([a for a in arguments if "timeout_min" in a]) == 1
    assert "hydra.launcher.n_jobs=2" in launching._arguments(tmp_path, 3, Launcher("joblib", 2))
    assert launching._slots(Launcher("submitit_local", 3)) == 3
    assert launching._slots(Launcher("joblib", 3)) is None


def test_waiting_jobs_get_a_slot_when_they_start_and_see_the_gpus_of_the_call(tmp_path, monkeypatch):
    """submitit starts all jobs at once, and sets CUDA_VISIBLE_DEVICES to nothing on this machine."""
    jobs = fake_plan(tmp_path, systems=("snarf",)).jobs
    seen = []

    def run_job(job, *, stopped):
        seen.append((current_slot(), os.environ.get("CUDA_VISIBLE_DEVICES")))
        return JobStatus("done", job.digest)

    monkeypatch.setattr(launching, "run_job", run_job)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    for visible in ("2,5", None):
        plan = PlannedJobs(3, tuple(jobs), visible)
        write_json(tmp_path / "plan.json", asdict(plan))
        with hold_slot(tmp_path):
            run_planned_job(tmp_path / "plan.json", 0)
    assert seen == [(1, "2,5"), (1, None)]
    assert os.environ["CUDA_VISIBLE_DEVICES"] == ""

    write_json(tmp_path / "plan.json", asdict(PlannedJobs(None, tuple(jobs), "2,5")))
    with use_slot(4):  # of a launcher that starts a job when it can run, or of a cluster, which assigns GPUs itself
        run_planned_job(tmp_path / "plan.json", 0)
    assert seen[2:] == [(4, "")]


def test_a_job_that_is_not_in_the_plan_is_rejected(tmp_path):
    with pytest.raises(UserError, match="no plan at"):
        run_planned_job(tmp_path / "plan.json", 0)
    (tmp_path / "plan.json").write_text('{"jobs": [], "slots": null}')
    with pytest.raises(UserError, match="has no job 3"):
        run_planned_job(Path(tmp_path / "plan.json"), 3)
