"""Commands in new processes: their output and exit code, their processor time, and how they are asked to end."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from snarfcli.reproduce.running import JobStopped, processor_s_of_children, run_command


def test_a_command_leaves_what_it_says_and_its_exit_code(tmp_path):
    log = tmp_path / "log"
    assert run_command(["train", "training=quik"], log, lambda: False) == 2
    assert log.read_text().startswith("$ snarf train training=quik\n")
    assert "did you mean 'quick'" in log.read_text()


@pytest.mark.skipif(os.name != "posix", reason="the system tells the processor time of children on Unix alone")
def test_the_processor_time_of_a_command_is_known(tmp_path):
    before = processor_s_of_children()
    run_command(["--version"], tmp_path / "log", lambda: False)
    assert processor_s_of_children() > before


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_a_command_that_is_stopped_is_asked_once(tmp_path, monkeypatch):
    script = tmp_path / "program.py"
    script.write_text(
        "import signal, sys, time\n"
        "def handle(*_): print('checkpoint written', flush=True); sys.exit(143)\n"
        "signal.signal(signal.SIGTERM, handle)\nprint('ready', flush=True)\ntime.sleep(600)\n"
    )
    original = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda command, **more: original([sys.executable, str(script)], **more))
    log = tmp_path / "log"
    with pytest.raises(JobStopped):
        run_command(["train"], log, lambda: log.exists() and "ready" in log.read_text())
    assert log.read_text().count("checkpoint written") == 1
