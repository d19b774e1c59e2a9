"""The jobs of a plan are run, watched, stopped, and tried once more where that can help."""

from __future__ import annotations

import errno
import importlib.util
import json
import logging
import os
import signal
import socket
import subprocess
import sys

import pytest
from fake_gpus import install_gpus
from fake_jobs import FakeJobs
from fake_runs import fake_plan, fake_run

from snarfcli.errors import UserError
from snarfcli.hydra_config.launchers import is_installed
from snarfcli.reproduce import launching
from snarfcli.reproduce.jobs import JobStatus
from snarfcli.reproduce.launchers import Launcher, LocalProcesses
from snarfcli.reproduce.launching import check_launcher, default_processes, launch


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(launching, "_LOOK_EVERY_S", 0.02)


@pytest.fixture
def jobs(tmp_path):
    return fake_plan(tmp_path, systems=("snarf", "nasa", "back_d")).jobs


def fake_jobs(tmp_path, monkeypatch, actions):
    """Let jobs be started that do what `actions` says, with their files in a folder of their own."""
    folder = tmp_path / "fake"
    folder.mkdir()
    return FakeJobs(folder, monkeypatch, actions)


@pytest.mark.parametrize("name", ["local", "joblib"])
def test_a_launcher_brings_every_job_to_its_end(name, jobs, tmp_path, monkeypatch):
    if name != "local" and not is_installed(name):
        pytest.skip(f"hydra-{name}-launcher is not installed")
    monkeypatch.chdir(tmp_path)
    for job in jobs:  # all results exist, so that only the launcher is tested
        fake_run(job, {"id": 0.9, "ood": 0.8})
    seen, looks = [], []
    statuses = launch(jobs, tmp_path / "work", Launcher(name, 2), lambda *change: seen.append(change), lambda: looks.append(0))
    said = [path.read_text() for path in tmp_path.glob("work/*/*.log")]
    assert [status and (status.state, status.tries) for status in statuses] == [("done", 1)] * 3, (statuses, said)
    assert {number for number, status in seen if status.state == "done"} == {0, 1, 2}
    assert len(seen) <= 6
    assert looks
    assert {path.name for path in tmp_path.iterdir()} == {"data", "outputs"}, "nothing is left behind"


def test_a_launcher_that_does_not_start_is_an_error(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(launching, "write_plan", lambda *_: None)
    with pytest.raises(UserError, match=r"launcher=local started no job: no plan at .*plan\.json; see .*0\.log"):
        launch(jobs, tmp_path / "work", Launcher(), lambda *_: None)


@pytest.mark.skipif(not is_installed("joblib"), reason="hydra-joblib-launcher is not installed")
def test_a_launcher_of_hydra_that_does_not_start_is_an_error(jobs, tmp_path):
    with pytest.raises(UserError, match=r"launcher=joblib started no job: .*Key 'njobs' not in .*; see .*launcher\.log"):
        launch(jobs, tmp_path / "work", Launcher("joblib", settings=("njobs=2",)), lambda *_: None)


def test_failures_that_may_pass_are_tried_once_more_and_those_without_memory_alone(jobs, tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO, "snarfcli")
    jobs = [*jobs, *fake_plan(tmp_path, systems=("pose_onet", "back_lbs")).jobs]
    fake = fake_jobs(tmp_path, monkeypatch, {
        0: ["fail alone", "done"], 1: ["fail again", "fail"], 2: ["fail"], 3: ["signal SIGSEGV", "done"],
        4: ["break SIGKILL", "break"],
    })  # fmt: skip
    seen = []
    statuses = launch(jobs, tmp_path / "work", Launcher(processes=2), lambda *change: seen.append(change))
    assert [(status.state, status.tries) for status in statuses if status] == [
        ("done", 2), ("failed", 2), ("failed", 1), ("done", 2), ("failed", 2),
    ]  # fmt: skip
    order = fake.started()
    assert sorted(order[:5]) == [0, 1, 2, 3, 4]
    assert sorted(order[5:7]) == [1, 3], "when all others have ended"
    assert order[7:] == [0, 4], "one after the other"
    assert [event[:2] for event in fake.events()[-3:]] == [[0, "start"], [0, "end"], [4, "start"]]
    told = [record.getMessage() for record in caplog.records if "once more" in record.getMessage()]
    assert f"{jobs[0].name}: train: no luck; it is tried once more when no other run works" in told
    assert f"{jobs[3].name}: reproduce: ended by SIGSEGV; it is tried once more when the other runs have ended" in told
    assert len(told) == 4
    assert [status.state for number, status in seen if number == 0 and status.state != "running"] == ["failed", "done"]


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_ctrl_c_stops_jobs_and_waits_for_them(jobs, tmp_path, monkeypatch):
    fake = fake_jobs(tmp_path, monkeypatch, {0: ["done"], 1: ["stop"], 2: ["done"]})
    seen = []

    def interrupt(number: int, status: JobStatus) -> None:
        seen.append((number, status.state))
        if (number, status.state) == (1, "running"):
            os.kill(os.getpid(), signal.SIGTERM)  # handled as Ctrl-C is

    with pytest.raises(KeyboardInterrupt):
        launch(jobs, tmp_path / "work", Launcher(), interrupt)
    assert fake.events()[-1][:2] == [1, "end"], "it was waited for"
    assert seen[-1] == (1, "stopped")
    assert fake.started() == [0, 1], "nothing was started any more"
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_a_second_ctrl_c_kills_the_jobs(jobs, tmp_path, monkeypatch):
    fake = fake_jobs(tmp_path, monkeypatch, {0: ["hang"]})
    processes = []

    def wait(self: LocalProcesses) -> None:
        processes.extend(child.process for child in self._running.values())
        raise KeyboardInterrupt  # while it waits for the checkpoints

    def interrupt() -> None:
        if fake.hanging():
            raise KeyboardInterrupt

    monkeypatch.setattr(LocalProcesses, "wait", wait)
    with pytest.raises(KeyboardInterrupt):
        launch(jobs[:1], tmp_path / "work", Launcher(), lambda *_: None, interrupt)
    assert [process.returncode for process in processes] == [-signal.SIGKILL]


def test_jobs_do_not_outlive_an_error_of_the_call(jobs, tmp_path, monkeypatch):
    fake = fake_jobs(tmp_path, monkeypatch, {0: ["stop"]})

    def fail(number: int, status: JobStatus) -> None:
        raise MemoryError

    with pytest.raises(MemoryError):
        launch(jobs[:1], tmp_path / "work", Launcher(), fail)
    assert fake.events()[-1][:2] == [0, "end"], "it was waited for"


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_jobs_that_cannot_be_asked_to_end_are_killed(jobs, tmp_path, monkeypatch):
    fake = fake_jobs(tmp_path, monkeypatch, {0: ["hang"]})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def fail() -> None:
        if fake.hanging():
            raise MemoryError

    monkeypatch.setattr(launching, "ask_to_stop", full)
    with pytest.raises(MemoryError):
        launch(jobs[:1], tmp_path / "work", Launcher(), lambda *_: None, fail)
    with pytest.raises(ProcessLookupError):  # it was waited for
        os.kill(fake.hanging()[0], 0)


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


@pytest.mark.parametrize("any_plugin", [True, False])
def test_launchers_that_are_not_installed_name_what_to_install(monkeypatch, any_plugin):
    def find_spec(name):
        if not any_plugin:  # as importlib does if the parent package is missing too
            raise ModuleNotFoundError(f"No module named {name.partition('.')[0]!r}")

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    check_launcher("local")
    with pytest.raises(UserError, match=r"^launcher=joblib needs hydra-joblib-launcher; .*: pip install 'snarf\[joblib\]'"):
        check_launcher("joblib")
    with pytest.raises(UserError, match=r"pip install 'snarf\[submitit\]'"):
        check_launcher("submitit_slurm")
    with pytest.raises(UserError, match="launcher_settings: wanted none with launcher=local"):
        check_launcher("local", ["partition=gpu"])


def test_as_many_jobs_run_as_there_are_gpus_or_cores_with_memory(monkeypatch):
    asked = []
    monkeypatch.setattr(launching, "choose_processes", lambda jobs, bytes_each: asked.append((jobs, bytes_each)) or 6)
    install_gpus(monkeypatch, [], None)
    assert default_processes("local", 9, "auto") == default_processes("joblib", 9, "cpu") == 6
    assert asked == [(9, 2**30)] * 2
    install_gpus(monkeypatch, [(9, 0)] * 4, None)
    for device, jobs, wanted in (("auto", 9, 4), ("cuda", 3, 3), ("cuda:1", 9, 1), ("cpu", 9, 6)):
        assert default_processes("local", jobs, device) == wanted
    assert default_processes("submitit_slurm", 9, "auto") == 9
    monkeypatch.setenv("SNARF_GPU_SLOT", "1")
    assert default_processes("local", 9, "cuda") == 1, "all jobs use the GPU that the user has given"


def test_processes_of_launchers_that_start_all_jobs_are_limited_and_share_the_cores(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(launching, "count_cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)

    def plan(launcher: Launcher) -> tuple[int | None, int | None]:
        plan = launching._Call(jobs, tmp_path, launcher, lambda *_: None, None)._plan()
        return plan.slots, plan.threads

    assert plan(Launcher("submitit_local", 3)) == (3, 2)
    assert plan(Launcher("joblib", 3)) == (None, 2)
    assert plan(Launcher("joblib", 3, threads=5)) == (None, None), "the commands name them"
    assert plan(Launcher("submitit_slurm", 3)) == (None, None)
