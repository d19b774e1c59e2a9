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
from snarfcli.reproduce.jobs import STATUS, run_job
from snarfcli.reproduce.planning import make_plan
from snarfcli.reproduce.plans import ExperimentOptions
from snarfcli.reproduce.running import JobStopped
from snarfcli.reproduce.speed import count_steps, timed_arguments


@pytest.fixture
def job(tmp_path):
    """A run of two minutes of two cores."""
    return fake_plan(tmp_path, "minutes", systems=("ours-2",), threads=2).jobs[0]


class ShortTrainings:
    """Stand for `snarf`: write the metrics of short trainings, whose steps take some time after the first ones."""

    def __init__(self, job, step_s=0.5, **changes) -> None:
        self.job, self.step_s, self.changes, self.calls = job, step_s, changes, []

    def __call__(self, arguments) -> bool:
        self.calls.append(arguments)
        folder = Path(self.job.folder) / "speed"
        assert not folder.exists(), "each begins anew"
        given = dict(argument.split("=", 1) for argument in arguments[1:])
        steps, every = (int(given[f"training.{name}"]) for name in ("steps", "validate_every"))

        def time_of(step):
            return 9.0 + step * self.step_s  # the first steps take longer

        content = {
            "steps": steps, "machine": {"cores": 2},
            "timings": {"seconds_per_step": 2.0 * self.step_s, "processor_s": time_of(steps)},
            "validations": [
                {"step": step, "seconds": 2 * time_of(step), "processor_s": time_of(step)}
                for step in range(every, steps + 1, every)
            ],
        }  # fmt: skip
        path = folder / self.job.data / self.job.subject / Path(self.job.folder).name / "metrics.json"
        write_json(path, content | self.changes)
        return True

    def steps(self) -> list[int]:
        """Return the number of steps of each."""
        return [int(one.partition("=")[2]) for call in self.calls for one in call if one.startswith("training.steps=")]


def test_steps_follow_from_the_processor_time_of_steps_after_the_first_ones(job):
    assert job.minutes == 4.0, "of one core"
    assert count_steps(job, ShortTrainings(job)) == 480
    assert count_steps(job, ShortTrainings(job, machine={"gpu": "H200"})) == 240, "the wall time on a GPU"
    mean, processor = {"seconds_per_step": 0.8}, {"processor_s": 60.0}
    trainings = ShortTrainings(job, steps=100, timings=mean | processor, validations=[])
    assert count_steps(job, trainings) == 400, "no held-back frames, so the mean of all steps"
    assert count_steps(job, ShortTrainings(job, timings=mean, validations=[])) == 300
    assert count_steps(job, ShortTrainings(job, step_s=1000.0)) == 1
    with pytest.raises(UserError, match=r"the time of a step is unknown: .*metrics.json is damaged \(metrics.timings"):
        count_steps(job, ShortTrainings(job, timings="fast"))
    assert count_steps(job, lambda arguments: False) is None
    with pytest.raises(UserError, match=r"no metrics at .*metrics\.json"):
        count_steps(job, lambda arguments: True)
    assert not (Path(job.folder) / "speed").exists()


@pytest.mark.parametrize(("step_s", "wanted"), [(0.05, [8, 120]), (0.2, [8, 120]), (0.5, [8, 48]), (1.2, [8, 18]), (3.0, [8])])
def test_what_is_measured_takes_about_a_tenth_of_the_minutes(job, step_s, wanted):
    trainings = ShortTrainings(job, step_s)
    count_steps(job, trainings)
    assert trainings.steps() == wanted
    assert wanted[-1] * step_s <= 24.0
    for call in trainings.calls:
        assert call[: len(job.train)] == job.train
        assert call[-1] == f"output_root='{job.folder}/speed'", "the last one counts"


def test_a_second_short_training_that_fails_is_not_replaced_by_the_first(job):
    trainings = ShortTrainings(job)
    assert count_steps(job, lambda arguments: trainings(arguments) and len(trainings.calls) < 2) is None


def test_the_commands_have_one_thread_and_the_steps_that_fit(job):
    assert [one for one in job.train if one.startswith("threads")] == ["threads=1"]
    assert "threads=2" in job.evaluations[0].arguments
    assert not [one for one in job.train if one.startswith("training.validate_every")], "that follows from the steps"
    curve = ("training.validate_every=40", "training.validation_frames=8")
    assert timed_arguments(job, 480) == (*job.train, "training.steps=480", *curve)
    assert "training.validate_every=1" in timed_arguments(job, 5)
    given = replace(job, train=(*job.train, "training.validate_every=7", "training.validation_frames=3"))
    assert timed_arguments(given, 480) == (*given.train, "training.steps=480")


class Commands:
    """Replaces `snarf`: writes the files of its commands; a command ends with a given exit code, 130 is an interruption."""

    def __init__(self, job, **codes: int) -> None:
        self.job, self.codes, self.calls = job, codes, []
        self.short = ShortTrainings(job)

    def __call__(self, arguments, log, stopped):
        is_short = f"output_root='{self.job.folder}/speed'" in arguments
        command = "speed" if is_short else next((a[6:] for a in arguments if a.startswith("split=")), arguments[0])
        self.calls.append((command, *[one for one in arguments if one.startswith("training.steps=")][-1:]))
        Path(log).write_text("busy\nsnarf train: the reason: what to do\n")
        code = self.codes.get(command, 0)
        if code == 130:
            raise JobStopped
        if code == 0 and is_short:
            self.short(arguments)
        elif code == 0:
            fake_run(self.job, {"id": 0.9, "ood": 0.8})
        return code


def test_the_speed_is_measured_once(job):
    (Path(job.folder) / "speed/builtin").mkdir(parents=True)
    commands = Commands(job, train=130)
    status = run_job(job, runner=commands)
    assert commands.calls == [
        ("speed", "training.steps=8"), ("speed", "training.steps=48"), ("train", "training.steps=480"),
    ]  # fmt: skip
    assert (status.state, status.stage, status.steps) == ("stopped", "train", 480)
    assert not (Path(job.folder) / "speed").exists()
    again = Commands(job)
    status = run_job(job, runner=again)
    assert again.calls[0] == ("train", "training.steps=480"), "a training can only be continued with the same number"
    assert (status.state, status.steps) == ("done", 480)
    assert read(Path(job.folder) / STATUS)["steps"] == 480
    other = Commands(replace(job, digest="another"), train=2)
    assert run_job(other.job, runner=other).state == "failed"
    assert [call[0] for call in other.calls] == ["speed", "speed", "train"], "measured again for other settings"
    write_json(Path(job.folder) / STATUS, read(Path(job.folder) / STATUS) | {"steps": 0})
    damaged = Commands(other.job)
    assert run_job(damaged.job, runner=damaged).steps == 480, "a number that cannot be is not kept"


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
    monkeypatch.setattr(speed, "_FIRST", speed._Probe(2, 6))
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
