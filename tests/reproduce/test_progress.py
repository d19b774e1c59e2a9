"""Progress of running jobs, read from their logs, and the time left of a plan."""

from __future__ import annotations

import logging
import os
import random
from pathlib import Path

import pytest
from fake_runs import FAKE_MACHINE, fake_plan, fake_run

from snarfcli.files import write_json
from snarfcli.reproduce import progress
from snarfcli.reproduce.durations import Durations, machine_name
from snarfcli.reproduce.jobs import LOG, STATUS, JobStatus
from snarfcli.reproduce.progress import PlanProgress, StageProgress, left_seconds, read_progress

TRAIN = "$ snarf train subject='50002' data=builtin seed=0\ndata: builtin, subject 50002, 9 sequences, 486 frames to train on\n"
STEPS = (
    "step 93 of 1200, loss occupancy 0.4350, 59k points/s, 179 s left\nstep 300 of 1200, loss occupancy 0.3, IoU 74.1/53.0\n"
)
EVAL = "$ snarf eval subject='50002' data=builtin split=ood run=x\ndata: builtin: 7 sequences, 56 frames\n"
FRAMES = "eval 50002 ood: 20 of 56 frames, 3.1 frames/s\n"
MESHES = "$ snarf preprocess subject='50002'\npreprocess 50002: 120 of 602 frames, 11.0 frames/s\n"

LOGS = {
    "": None,
    TRAIN: None,
    TRAIN + STEPS: StageProgress("train", 300, 1200, "steps"),
    TRAIN + "resuming at step 600 of 1200\n": StageProgress("train", 600, 1200, "steps"),
    TRAIN + STEPS + EVAL: None,
    TRAIN + STEPS + EVAL + FRAMES: StageProgress("ood", 20, 56, "frames"),
    MESHES: StageProgress("samples", 120, 602, "frames"),
    STEPS: StageProgress(None, 300, 1200, "steps"),
    TRAIN + STEPS + "step 7 of 3, loss\nstep 0 of 0, loss\nstep 99999999999 of 9, \n": StageProgress(
        "train", 300, 1200, "steps"
    ),
}


@pytest.mark.parametrize("text", LOGS, ids=lambda text: repr(text[-30:]))
def test_the_progress_of_the_last_command_is_read_from_the_log(text, tmp_path):
    log = tmp_path / LOG
    log.write_text(text)
    assert read_progress(log) == LOGS[text]


def test_any_content_of_a_log_can_be_read(tmp_path):
    log, draw = tmp_path / LOG, random.Random(0)
    assert read_progress(tmp_path / "none") is None
    whole = (TRAIN + STEPS + EVAL + FRAMES).encode()
    for _ in range(200):
        damaged = bytearray(whole * draw.randint(1, 3))
        for _ in range(draw.randint(0, 20)):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        log.write_bytes(bytes(damaged[draw.randrange(len(damaged)) :]))
        found = read_progress(log)
        assert found is None or 0 <= found.share <= 1
    log.write_bytes(b"x" * 10**6 + b"\n" + STEPS.encode())
    assert read_progress(log) == LOGS[STEPS], "only the end is read"


def write_status(job, state, stage, log="", **more):
    folder = Path(job.folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / LOG).write_text(log)
    write_json(folder / STATUS, vars(JobStatus(state, job.digest, stage=stage, **more)))


@pytest.fixture
def plan(tmp_path):
    return fake_plan(tmp_path, systems=("nasa", "snarf"), seeds=(0, 1))


def durations_of(plan, tmp_path):
    return Durations(tmp_path / "durations.json", plan.jobs, machine_name(FAKE_MACHINE), 1)


def test_what_a_run_still_takes_follows_its_stage(plan, tmp_path):
    first, _, second, _ = plan.jobs
    fake_run(first, {"id": 0.9, "ood": 0.8}, spent_s={"train": 100.0, "id": 10.0, "ood": 10.0})
    known = durations_of(plan, tmp_path)
    assert left_seconds(first, known) == 0
    os.utime(first.evaluations[0].metrics, (1, 1))
    assert left_seconds(first, known) == 10, "an evaluation older than the avatar is made again"
    assert left_seconds(second, known) == 120
    write_status(second, "stopped", "train", TRAIN + STEPS)
    assert left_seconds(second, known) == 95
    fake_run(second, {"id": 0.9}, "running")
    write_status(second, "running", "ood", EVAL + FRAMES.replace("56", "40"), trained=True)
    assert left_seconds(second, known) == 5


def test_progress_is_shown_in_lines_and_runs_that_end_give_better_estimates(plan, tmp_path, caplog, monkeypatch):
    caplog.set_level(logging.INFO, "snarfcli")
    clock, ended = [1000.0], []
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    known = durations_of(plan, tmp_path)
    shown = PlanProgress(plan.jobs, 2, known, ended.append)
    shown.begin()
    for number in (0, 1):
        write_status(plan.jobs[number], "running", "train", TRAIN + (STEPS if number else ""))
        shown.on_change(number, JobStatus("running"))
    shown.look()
    assert "0 of 4 runs done" not in caplog.text, "once a minute"
    clock[0] += 90
    shown.look()
    shown.look()
    (block,) = [record.message for record in caplog.records if "0 of 4 runs done, 2 running; about " in record.message]
    _, nasa, snarf = block.splitlines()
    assert " ".join(nasa.split()) == "train for 2 min NASA, subject 50002, seed 0"
    assert " ".join(snarf.split()) == "train 25 %, 300 of 1200 steps for 2 min SNARF, subject 50002, seed 0"

    times = {"train": 200.0, "id": 20.0, "ood": 20.0}
    values = {"id": 0.9, "ood": 0.8, "step_s": 0.1}
    fake_run(plan.jobs[0], values, spent_s={name: seconds / 4 for name, seconds in times.items()})
    shown.on_change(0, JobStatus("done", seconds=times))
    assert ended == [0]
    assert shown.done == 1
    assert known.of(plan.jobs[2]).total_s == 60, "processor time is twice as much, so the machine had no other work"
    assert (tmp_path / "durations.json").is_file()
    assert "1 of 4: NASA, subject 50002, seed 0: bbox 95.0/90.0, surface 90.0/80.0" in caplog.text
    assert shown._taken_s / shown._estimated_s == 4, "four times as long as it would take undisturbed"
    fake_run(plan.jobs[2], {"id": 0.9, "ood": 0.8})
    shown.on_change(2, JobStatus("done"))
    assert ended == [0], "it was done before"
    shown.on_change(1, JobStatus("stopped"))
    assert shown.lines() == [f"2 of 4 runs done, 0 running{shown._left()}"]
    shown.close()
