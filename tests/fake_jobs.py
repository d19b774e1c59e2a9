"""Processes that stand for `snarf reproduce_job`: they start in milliseconds and do what a test has written for each try."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from snarfcli.files import write_json
from snarfcli.reproduce import launchers
from snarfcli.reproduce.jobs import JobStatus

_PROGRAM = """
import json, os, pathlib, signal, subprocess, sys, time

folder = pathlib.Path(sys.argv[1])
settings = dict(one.split("=", 1) for one in sys.argv[3:])
work, number = pathlib.Path(settings["plan"].strip("'")).parent, settings["job"]
result = work / f"{number}.json"
before = json.loads(result.read_text()) if result.exists() else {"tries": 0}
base = json.loads((folder / "status.json").read_text()) | {"tries": before["tries"] + 1}

def write(status):
    (work / f".{number}.new").write_text(json.dumps(base | status))
    os.replace(work / f".{number}.new", result)

def tell(event):
    shares = work / "threads.json"
    threads = json.loads(shares.read_text()).get(number) if shares.exists() else None
    (folder / "events").open("a").write(json.dumps([int(number), event, os.environ["SNARF_GPU_SLOT"], threads]) + "\\n")

def wait_for(condition):
    end = time.monotonic() + 60
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)

tell("start")
(folder / f"started {number}").touch()
actions = json.loads((folder / "actions.json").read_text())[number]
action, _, of = actions[min(base["tries"], len(actions)) - 1].partition(" ")
if action == "break":
    if of:
        os.kill(os.getpid(), getattr(signal, of))
    print("cannot start")
    sys.exit(1)
write({"state": "running"})
if action == "after":
    wait_for(lambda: (folder / f"ended {of}").exists())
if action == "meet":
    wait_for(lambda: all((folder / f"started {other}").exists() for other in of.split()))
if action == "signal":
    os.kill(os.getpid(), getattr(signal, of))
if action == "fail":
    write({"state": "failed", "stage": "train", "reason": "no luck", "retry": of})
elif action == "stop":
    wait_for((work / "stop").exists)
    tell("stopped")
    write({"state": "stopped"})
elif action == "hang":
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    (folder / "hanging").write_text(f"{os.getpid()} {child.pid}")
    child.wait()
else:
    write({"state": "done"})
tell("end")
(folder / f"ended {number}").touch()
"""


class FakeJobs:
    """Jobs of a plan, and what they have told."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, actions: Mapping[int, Sequence[str]]) -> None:
        """Let the launcher start fake jobs.

        Args:
            folder: an existing folder for their files.
            monkeypatch: pytest's.
            actions: for each job what it does in its first, second, ... try: done, "after N" (done when job N has ended),
                "meet N M ..." (done when those have begun), "fail RETRY", "signal NAME" (is ended by it), stop (waits until
                it is asked to), hang, or "break" or "break NAME" (ends before it begins).
        """
        self.folder = folder
        write_json(folder / "actions.json", {str(number): list(of_job) for number, of_job in actions.items()})
        write_json(folder / "status.json", asdict(JobStatus("running", "digest")))
        command = [sys.executable, "-c", _PROGRAM, str(folder)]
        monkeypatch.setattr(launchers, "snarf_command", lambda arguments: [*command, *arguments])

    def events(self) -> list[list[Any]]:
        """Return [number, start, stopped or end, slot, threads] of all jobs, in the order of time."""
        return [json.loads(line) for line in (self.folder / "events").read_text().splitlines()]

    def started(self) -> list[int]:
        """Return the jobs in the order in which they began."""
        return [event[0] for event in self.events() if event[1] == "start"]

    def hanging(self) -> list[int]:
        """Return the processes of a job that hangs; empty before it does."""
        path = self.folder / "hanging"
        return [int(one) for one in path.read_text().split()] if path.exists() else []
