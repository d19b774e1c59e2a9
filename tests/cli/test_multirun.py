"""Jobs of `-m` in other processes: exit codes, lost jobs, and launchers that do not exist."""

from __future__ import annotations

import importlib.util
import os
import signal

import pytest

from snarfcli.cli import main as cli
from snarfcli.commands import doctor
from snarfcli.hydra_config.launchers import is_installed

needs_joblib = pytest.mark.skipif(not is_installed("joblib"), reason="hydra-joblib-launcher is not installed")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(capsys, *arguments):
    """Run the command line in this process; return exit code and standard error."""
    code = cli.main(arguments)
    return code, capsys.readouterr().err


@needs_joblib
def test_the_highest_exit_code_of_jobs_in_other_processes_comes_back(capsys, elsewhere, monkeypatch):
    monkeypatch.setattr(doctor, "run", lambda config: int(config.subject))
    folder = f"hydra.sweep.dir={elsewhere}/sweeps"
    jobs = ("doctor", "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", folder)
    assert run(capsys, *jobs, "subject=0,2,1") == (2, "snarf doctor: 2 of 3 jobs failed\n")
    assert {path.name for path in (elsewhere / "sweeps").iterdir()} == {"multirun.yaml"}, "nothing is left behind"
    assert run(capsys, "doctor", "-m", "subject=0,3,1", folder) == (3, "")


@needs_joblib
@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_a_job_that_is_killed_ends_the_call_in_one_line(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "run", lambda config: os.kill(os.getpid(), signal.SIGKILL))
    code, error = run(capsys, "doctor", "-m", "subject=1,2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    assert code == 2
    assert error.startswith("snarf doctor: hydra/launcher: a job ended without a result (A worker process")
    assert error.endswith("; if memory ran out, run fewer jobs at a time\n")
    assert error.count("\n") == 1


@pytest.mark.parametrize("more", [(), ("-m",)])
def test_a_launcher_that_does_not_exist_is_named_with_those_that_do(capsys, monkeypatch, more):
    known = "choose from basic, joblib, submitit_local, submitit_slurm"
    wanted = f"snarf doctor: there is no hydra/launcher=jobib; did you mean 'joblib'?; {known}\n"
    assert run(capsys, "doctor", *more, "hydra/launcher=jobib") == (2, wanted)
    wanted = "snarf doctor: there is no hydra/sweeper=banana; choose from basic\n"
    assert run(capsys, "doctor", *more, "hydra/sweeper=banana") == (2, wanted)
    if importlib.util.find_spec("submitit") is None:
        code, error = run(capsys, "doctor", *more, "hydra/launcher=submitit_slurm")
        assert code == 2
        assert "hydra/launcher=submitit_slurm needs hydra-submitit-launcher; install it with: pip install" in error
        assert error.count("\n") == 1
