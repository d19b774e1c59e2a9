"""Trainings with a budget of minutes: what is measured, how many steps follow, and that a resumed run keeps them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_plan, fake_run, read
from toy_training import toy_store

from snarfcli.cli import main as cli
from snarfcli.commands.reproduce import resolve_training
from snarfcli.errors import UserError
from snarfcli.files import write_json
from snarfcli.reproduce import speed
from snarfcli.reproduce.experiments import EXPERIMENTS
from snarfcli.reproduce.jobs import STATUS, JobStopped, run_job
from snarfcli.reproduce.planning import make_plan
from snarfcli.reproduce.plans import ExperimentOptions
from snarfcli.reproduce.speed import measured_steps, speed_arguments, timed_arguments


@pytest.fixture
def job(tmp_path):
    """A run of two minutes of two cores."""
    return fake_plan(tmp_path, "minutes", systems=("ours-2",), threads=2).jobs[0]


def at(step, seconds, processor_s):
    return {"step": step, "seconds": seconds, "processor_s": processor_s, "iou_surface": 0.5}


def measured(job, **changes):
    """Write the metrics of a short training, whose steps take 0.5 s of one core after the first ones."""
    content = {
        "steps": 120, "machine": {"cores": 2}, "timings": {"seconds_per_step": 0.8, "processor_s": 72.0},
        "validations": [at(20, 30.0, 22.0), at(40, 43.0, 30.0), at(120, 96.0, 72.0)],
    }  # fmt: skip
    write_json(Path(job.folder) / "speed" / job.data / job.subject / Path(job.folder).name / "metrics.json", content | changes)


def test_steps_follow_from_the_processor_time_of_steps_after_the_first_ones(job):
    assert job.minutes == 4.0, "of one core"
    measured(job)
    assert measured_steps(job) == 480
    measured(job, machine={"gpu": "H200"})
    assert measured_steps(job) == round(240 / 0.66), "the wall time on a GPU"
    measured(job, validations=[])
    assert measured_steps(job) == 400, "no held-back frames, so the mean of all steps"
    measured(job, validations=[], timings={"seconds_per_step": 0.8})
    assert measured_steps(job) == 300
    measured(job, timings={"seconds_per_step": 1000.0, "processor_s": 120_000.0}, validations=[])
    assert measured_steps(job) == 1
    measured(job, timings="fast")
    with pytest.raises(
        UserError, match=r"cannot measure the time of a step, since .*metrics.json is damaged \(metrics.timings"
    ):
        measured_steps(job)


def test_the_commands_have_one_thread_and_the_steps_that_fit(job):
    assert [one for one in job.train if one.startswith("threads")] == ["threads=1"]
    assert "threads=2" in job.evaluations[0].arguments
    assert not [one for one in job.train if one.startswith("training.validate_every")], "that follows from the steps"
    short = speed_arguments(job)
    assert short[: len(job.train)] == job.train
    assert short[-1] == f"output_root='{job.folder}/speed'", "the last one counts"
    curve = ("training.validate_every=40", "training.validation_frames=8")
    assert timed_arguments(job, 480) == (*job.train, "training.steps=480", *curve)
    assert "training.validate_every=1" in timed_arguments(job, 5)
    given = replace(job, train=(*job.train, "training.validate_every=7", "training.validation_frames=3"))
    assert timed_arguments(given, 480) == (*given.train, "training.steps=480")


class Commands:
    """Replaces `snarf`: writes the files of its commands; a command ends with a given exit code, 130 is an interruption."""

    def __init__(self, job, **codes: int) -> None:
        self.job, self.codes, self.calls = job, codes, []

    def __call__(self, arguments, log, stopped):
        is_short = f"output_root='{self.job.folder}/speed'" in arguments
        assert not (is_short and (Path(self.job.folder) / "speed").exists()), "a short training begins anew"
        command = "speed" if is_short else next((a[6:] for a in arguments if a.startswith("split=")), arguments[0])
        self.calls.append((command, *[one for one in arguments if one.startswith("training.steps=")][-1:]))
        Path(log).write_text("busy\nsnarf train: the reason: what to do\n")
        code = self.codes.get(command, 0)
        if code == 130:
            raise JobStopped
        if code == 0 and is_short:
            measured(self.job)
        elif code == 0:
            fake_run(self.job, {"id": 0.9, "ood": 0.8})
        return code


def test_the_speed_is_measured_once(job):
    (Path(job.folder) / "speed/builtin").mkdir(parents=True)
    commands = Commands(job, train=130)
    status = run_job(job, runner=commands)
    assert commands.calls == [("speed", "training.steps=120"), ("train", "training.steps=480")]
    assert (status.state, status.stage, status.steps) == ("stopped", "train", 480)
    assert not (Path(job.folder) / "speed").exists()
    again = Commands(job)
    status = run_job(job, runner=again)
    assert again.calls[0] == ("train", "training.steps=480"), "a training can only be continued with the same number"
    assert (status.state, status.steps) == ("done", 480)
    assert read(Path(job.folder) / STATUS)["steps"] == 480
    other = Commands(replace(job, digest="another"), train=2)
    assert run_job(other.job, runner=other).state == "failed"
    assert [call[0] for call in other.calls] == ["speed", "train"], "measured again for other settings"


def test_a_speed_that_cannot_be_measured_is_a_failure(job):
    commands = Commands(job, speed=2)
    status = run_job(job, runner=commands)
    assert (status.state, status.stage, status.reason, status.steps) == ("failed", "speed", "the reason: what to do", None)
    assert len(commands.calls) == 1
    status = run_job(job, runner=lambda arguments, log, stopped: 0)
    assert (status.state, status.stage) == ("failed", "speed")
    assert "metrics.json" in status.reason


def test_the_papers_recipe_has_the_papers_settings_and_ours_those_of_the_preset():
    rows = {row.key: row for row in EXPERIMENTS["minutes"].rows}
    assert list(rows) == [f"{name}-{m}" for name in ("papers_recipe", "ours_networks", "ours") for m in (2, 5, 20)]
    configs = {
        name: resolve_training([f"training={(row := rows[f'{name}-2']).training or 'quick'}", *row.settings("quick")])
        for name in ("papers_recipe", "ours_networks", "ours")
    }
    papers, networks, ours = configs.values()
    assert papers == resolve_training(["training=paper", "search=broyden", "search.jacobian=broyden"])
    assert networks["training"] == ours["training"] == resolve_training(["training=quick"])["training"]
    assert networks["search"] == ours["search"] == resolve_training([])["search"]
    start = {"shape": ("prior_radius_m", "geometric_init"), "skinning": ("prior_falloff_m", "sharpness")}
    for group, names in start.items():
        assert {name for name in papers[group] if papers[group][name] != networks[group][name]} == set(names), group
        quick = resolve_training(["training=quick", "shape=small", "skinning=coarse"])[group]
        assert {name: networks[group][name] for name in names} == {name: quick[name] for name in names}


def test_a_budget_and_a_number_of_steps_are_not_both_given(tmp_path):
    with pytest.raises(UserError, match=r"extra: training.steps follows from the minutes of row ours-2; leave it out"):
        fake_plan(tmp_path, "minutes", systems=("ours-2",), extra=("training.steps=9",))
    plans = [fake_plan(tmp_path, "minutes", systems=(name,)).jobs[0] for name in ("ours-2", "ours-5")]
    assert plans[0].digest != plans[1].digest


def test_a_real_training_of_a_budget(tmp_path, monkeypatch):
    """With the real commands, on a bending capsule: the speed, then as many steps as fit."""
    toy_store(tmp_path / "data", points=200, frames=8)
    monkeypatch.setattr(speed, "_UNCOUNTED", 2)
    monkeypatch.setattr(speed, "_STEPS", 6)
    extra = ("training.poses_per_step=1", "skinning.resolution=[8,8,8]", "shape.width=16", "skinning.bone_radius_m=0.3")
    options = ExperimentOptions(
        subjects=("toy",), training="smoke", systems=("ours-2",), extra=extra, data_root=str(tmp_path / "data"),
        output_root=str(tmp_path / "outputs"),
    )  # fmt: skip
    job = replace(make_plan(EXPERIMENTS["minutes"], options, resolve_training).jobs[0], minutes=0.001, evaluations=())

    def runner(arguments, log, stopped):
        Path(log).parent.mkdir(parents=True, exist_ok=True)
        Path(log).touch()
        return cli.main(list(arguments))

    status = run_job(job, runner=runner)
    assert status.state == "done", status
    metrics = read(Path(job.folder) / "metrics.json")
    assert status.steps is not None
    assert metrics["steps"] == status.steps
    assert all(one["processor_s"] > 0 for one in metrics["validations"])
    assert not (Path(job.folder) / "speed").exists()
