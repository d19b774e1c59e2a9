"""How long a run will take, from a few steps and frames: by fake commands whose times are known."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import pytest
from fake_runs import FAKE_MACHINE, fake_metrics, fake_plan, fake_samples

from snarfcli.errors import UserError
from snarfcli.files import write_json
from snarfcli.reproduce import dry_run, measuring
from snarfcli.reproduce.durations import Durations, machine_name
from snarfcli.reproduce.measuring import Measurements
from snarfcli.reproduce.running import JobStopped

STEP_S, VALIDATION_S, FRAME_S, START_S = 0.5, 4.0, 2.0, 5.0
FIRST_STEPS_S = 3.0  # that the first steps take longer


class Commands:
    """Stand for the commands, on clocks of their own: each command uses two threads for all of its time."""

    def __init__(self, monkeypatch, failing=()) -> None:
        self.now, self.failing, self.calls = 0.0, failing, []
        monkeypatch.setattr(measuring.time, "monotonic", lambda: self.now)
        monkeypatch.setattr(measuring, "processor_s_of_children", lambda: 2 * self.now)

    def __call__(self, arguments, log, stopped):
        given = dict(argument.partition("=")[::2] for argument in arguments[1:])
        given = {name: value.strip("'") for name, value in given.items()}
        assert len(given) == len(arguments) - 1, "a setting is given twice"
        self.calls.append((arguments[0], given))
        self.now += START_S
        if given.get("run") in self.failing:
            if self.failing[given["run"]] is JobStopped:
                raise JobStopped
            Path(log).write_text("busy\nsnarf train: no such luck\n")
            return 2
        getattr(self, arguments[0])(given)
        return 0

    def preprocess(self, given):
        fake_samples(Path(given["data_root"]), given["subject"], test=5, ood=4)

    def train(self, given):
        steps, every = int(given["training.steps"]), int(given["training.validate_every"])
        at = [step for step in range(1, steps + 1) if step % every == 0 or step == steps]
        steps_s = FIRST_STEPS_S + steps * STEP_S
        self.now += steps_s + len(at) * VALIDATION_S
        write_json(self.folder(given) / "metrics.json", {
            "steps": steps, "machine": FAKE_MACHINE | {"threads": 2},
            "validations": [{"step": step, "seconds": FIRST_STEPS_S + step * STEP_S} for step in at],
            "timings": {
                "seconds_per_step": steps_s / steps, "validation_seconds": len(at) * VALIDATION_S, "processor_s": 2 * steps_s,
            },
        })  # fmt: skip

    def eval(self, given):
        wall_s = FRAME_S * (1 + int(given["max_frames"]))
        self.now += wall_s
        content = fake_metrics(0.9, {}) | {"frames": int(given["max_frames"]), "timings": {"wall_s": wall_s}}
        write_json(self.folder(given) / "eval_id_part/metrics.json", content)

    def folder(self, given):
        return Path(given["output_root"]) / given["data"] / given["subject"] / given["run"]


def whole(job, frames):
    validations = math.ceil(job.steps / (job.steps // 6))
    train_s = START_S + job.steps * STEP_S + validations * VALIDATION_S
    return train_s, 2 * START_S + frames * FRAME_S


def test_a_whole_run_follows_from_a_few_steps_and_frames(tmp_path, monkeypatch):
    job = fake_plan(tmp_path, systems=("nasa",)).jobs[0]
    fake_samples(tmp_path / "data", "50002", test=60, ood=56)
    commands = Commands(monkeypatch)
    found = Measurements(tmp_path / "work", 3, commands).measure(job, {})
    train_s, evaluations_s = whole(job, 60 + 56)
    assert found.train_s == pytest.approx(train_s, abs=0.1), "without the first steps"
    assert found.evaluations_s == pytest.approx(evaluations_s, abs=0.1)
    assert found.train_processor_s == pytest.approx(2 * train_s, abs=0.1)
    assert found.evaluations_processor_s == pytest.approx(2 * evaluations_s, abs=0.1)
    assert found.threads == 2
    assert [name for name, _ in commands.calls] == ["train", "eval"]
    _, train = commands.calls[0]
    assert int(train["training.steps"]) < job.steps
    assert train["model"] == "nasa"
    assert train["data_root"] == str(tmp_path / "data")
    assert train["output_root"] == str(tmp_path / "work/outputs"), "not among the results"
    assert {given["threads"] for _, given in commands.calls} == {"3"}
    assert not (tmp_path / "outputs").exists()


def test_missing_samples_are_made_sparse_in_the_folder(tmp_path, monkeypatch):
    plan = fake_plan(tmp_path, systems=("nasa", "snarf"))
    (tmp_path / "data/processed/builtin/50002/manifest.json").unlink()
    commands = Commands(monkeypatch)
    measurements = Measurements(tmp_path / "work", 3, commands)
    found = [measurements.measure(job, {"frame_step": 4, "ood_frame_step": 60}) for job in plan.jobs]
    assert [name for name, _ in commands.calls] == ["preprocess", "train", "eval", "train", "eval"], "once for all rows"
    _, made = commands.calls[0]
    steps = ("data.frame_step", "data.test_frame_step", "data.ood_frame_step")
    assert [made[name] for name in steps] == ["48", "12", "720"]
    assert found[0].evaluations_s == pytest.approx(whole(plan.jobs[0], 12 * (5 + 4))[1], abs=0.1)
    assert not list((tmp_path / "data").rglob("manifest.json"))


def test_a_command_that_fails_gives_its_reason(tmp_path, monkeypatch):
    job = fake_plan(tmp_path, systems=("nasa",)).jobs[0]
    (tmp_path / "work").mkdir()
    with pytest.raises(UserError, match="snarf train: no such luck"):
        Measurements(tmp_path / "work", 3, Commands(monkeypatch, {"nasa": 2})).measure(job, {})


def test_only_unknown_rows_are_measured_and_an_interruption_keeps_the_others(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO, "snarfcli")
    plan = fake_plan(tmp_path, subjects=("50002", "50004"), systems=("pose_onet", "nasa", "snarf", "ours-local"))
    known = Durations(tmp_path / "durations.json", plan.jobs, machine_name(FAKE_MACHINE), 1)
    commands = Commands(monkeypatch, {"snarf": 2, "ours-local": JobStopped})
    monkeypatch.setattr(dry_run, "Measurements", lambda folder, threads: Measurements(folder, threads, commands))
    dry_run.measure_missing([plan], plan.jobs, known)
    assert [given["run"] for name, given in commands.calls if name == "train"] == ["pose_onet", "nasa", "snarf", "ours-local"]
    assert "warning: row snarf cannot be measured: snarf train: no such luck" in caplog.text
    assert "stopped measuring" in caplog.text
    assert [known.of(job).source for job in plan.jobs[:4]] == ["steps", "steps", "hint", "hint"]
    commands.calls.clear()
    commands.failing = {}
    dry_run.measure_missing([plan], plan.jobs, known)
    assert [given["run"] for name, given in commands.calls if name == "train"] == ["snarf", "ours-local"]
    commands.calls.clear()
    dry_run.measure_missing([plan], plan.jobs, known)
    assert commands.calls == []


def test_the_whole_plan_is_added_up(tmp_path, caplog):
    caplog.set_level(logging.INFO, "snarfcli")
    plan = fake_plan(tmp_path, subjects=("50002", "50004"), systems=("nasa", "snarf"))
    known = Durations(tmp_path / "durations.json", plan.jobs, machine_name(FAKE_MACHINE), 1)
    known.note_steps(plan.jobs[0], measuring.Duration(540.0, 60.0, 540.0, 60.0, 1, machine_name(FAKE_MACHINE)))
    known.note_steps(plan.jobs[1], measuring.Duration(1140.0, 60.0, 1140.0, 60.0, 1, machine_name(FAKE_MACHINE)))
    dry_run.print_durations(plan.jobs, known, 2)
    lines = caplog.messages[0].split("\n")
    assert " ".join(lines[2].split()) == "nasa builtin 2 2 10 min 20 min measured steps"
    assert " ".join(lines[3].split()) == "snarf builtin 2 2 20 min 40 min measured steps"
    assert caplog.messages[1].startswith("4 runs to run: about 40 min with processes=2, 60 min one after the other")
