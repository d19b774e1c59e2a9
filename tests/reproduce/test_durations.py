"""Estimates of how long runs take, and the order and the time of a plan that follow from them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest
from fake_runs import FAKE_MACHINE, fake_plan, fake_run, read

from snarfcli.reproduce.durations import Duration, Durations, longest_first, machine_name, plan_seconds, time_text

HERE = machine_name(FAKE_MACHINE)


@pytest.fixture
def plan(tmp_path):
    return fake_plan(tmp_path, subjects=("50002", "50004"), seeds=(3, 1), systems=("nasa", "snarf", "ours-local"))


def durations_of(plan, tmp_path, machine: str | None = HERE, threads=1):
    return Durations(tmp_path / "outputs/reproduce/durations.json", plan.jobs, machine, threads)


def job_of(plan, row, seed=3, subject="50002"):
    return next(job for job in plan.jobs if (job.row, job.seed, job.subject) == (row, seed, subject))


def test_hints_order_the_runs_of_each_seed_before_anything_is_known(plan, tmp_path):
    known = durations_of(plan, tmp_path)
    assert {known.of(job).source for job in plan.jobs} == {"hint"}
    # 24 min of 1,200 steps, of which these runs have 100
    assert known.of(job_of(plan, "snarf")).train_s == pytest.approx(24 * 60 * 100 / 1200)
    order = [(job.seed, job.row, job.subject) for job in longest_first(plan.jobs, known)]
    assert order == [
        (seed, row, subject) for seed in (3, 1) for row in ("snarf", "nasa", "ours-local") for subject in ("50002", "50004")
    ]


def test_a_finished_run_stands_for_those_of_other_subjects_and_seeds(plan, tmp_path):
    fake_run(job_of(plan, "ours-local"), {"id": 0.9, "ood": 0.8}, spent_s={"train": 300.0, "id": 30.0, "ood": 10.0})
    known = durations_of(plan, tmp_path)
    for seed, subject in ((3, "50004"), (1, "50002")):
        estimate = known.of(job_of(plan, "ours-local", seed, subject))
        assert (estimate.train_s, estimate.evaluations_s, estimate.source) == (300, 40, "runs")
        assert estimate.processor_s == 680
    # It took 600 s of processor time instead of the hint's 10 s, so the others will, too.
    assert known.of(job_of(plan, "snarf")).train_s == pytest.approx(120 * 600 / 10)
    assert known.of(job_of(plan, "snarf")).source == "hint"
    fake_run(job_of(plan, "snarf"), {"id": 0.9, "ood": 0.8, "step_s": 0.1}, spent_s={"train": 20.0, "id": 2.0, "ood": 2.0})
    order = [job.row for job in longest_first(plan.jobs, durations_of(plan, tmp_path))]
    assert order[:6] == ["nasa", "nasa", "ours-local", "ours-local", "snarf", "snarf"]


def test_other_settings_and_other_machines_do_not_count(plan, tmp_path):
    fake_run(job_of(plan, "nasa"), {"id": 0.9, "ood": 0.8}, spent_s={"train": 300.0, "id": 30.0, "ood": 10.0})
    assert durations_of(plan, tmp_path, "another processor, 64 cores").of(job_of(plan, "nasa")).source == "hint"
    assert durations_of(plan, tmp_path, None).of(job_of(plan, "nasa")).source == "runs", "a cluster has many machines"
    changes: list[dict[str, Any]] = [{"extra": ("training.steps=7",)}, {"training": "standard"}, {"max_frames": 3}]
    for change in changes:
        other = fake_plan(tmp_path, systems=("nasa",), **change)
        assert other.jobs[0].kind != job_of(plan, "nasa").kind, change
    same = fake_plan(tmp_path, systems=("nasa",), seeds=(9,), threads=2, device="cpu").jobs[0]
    assert same.kind == job_of(plan, "nasa").kind


def test_what_runs_took_is_kept_in_a_file(plan, tmp_path):
    first, second = job_of(plan, "nasa"), job_of(plan, "nasa", 1)
    known = durations_of(plan, tmp_path)
    fake_run(first, {"id": 0.9, "ood": 0.8}, spent_s={"train": 300.0, "id": 30.0, "ood": 10.0})
    known.note_run(first)
    other_plan = fake_plan(tmp_path, systems=("nasa",), seeds=(8,))
    assert durations_of(other_plan, tmp_path).of(other_plan.jobs[0]).train_s == 300, "of no run of this plan"
    measured = Duration(50.0, 5.0, 50.0, 5.0, 1, HERE)
    known.note_steps(job_of(plan, "snarf"), measured)
    again = durations_of(plan, tmp_path)
    assert again.of(job_of(plan, "snarf")).source == "steps"
    assert again.of(job_of(plan, "snarf")).total_s == 55
    assert again.of(second).source == "runs"
    for _ in range(9):
        again.note_run(first)
    (kind,) = [one for one in read(known.path)["kinds"].values() if one["row"] == "nasa"]
    assert len(kind["runs"]) == 5


def test_a_damaged_file_counts_as_empty(plan, tmp_path):
    path = tmp_path / "outputs/reproduce/durations.json"
    path.parent.mkdir(parents=True)
    for text in ("", "[]", '{"kinds": 3}', '{"kinds": {"x": {"runs": [{"train_s": "long"}]}}}', "\0", "[" * 10**5):
        path.write_text(text)
        known = durations_of(plan, tmp_path)
        assert known.of(plan.jobs[0]).source == "hint"
        known.note_steps(plan.jobs[0], Duration(50.0, 5.0, 50.0, 5.0, 1, HERE))
        assert json.loads(path.read_text())["kinds"].keys() == {plan.jobs[0].kind}


def test_a_run_of_an_older_version_is_known_by_its_steps(plan, tmp_path):
    job = job_of(plan, "nasa")
    fake_run(job, {"id": 0.9, "ood": 0.8, "step_s": 2.0})
    assert durations_of(plan, tmp_path).of(job).train_s == 200


def test_undisturbed_a_run_takes_at_most_its_processor_time():
    busy = Duration(900.0, 90.0, 300.0, 30.0, 1, HERE)  # beside other work
    assert busy.undisturbed(1) == (300, 30)
    two = Duration(200.0, 20.0, 300.0, 30.0, 2, HERE)
    assert two.undisturbed(2) == (200, 20)
    assert two.undisturbed(1) == (300, 30)
    assert replace(busy, gpu="a GPU").undisturbed(1) == (900, 90)


def test_the_time_of_a_plan_is_that_of_its_busiest_process():
    assert plan_seconds([5, 4, 3, 3], 2) == 8
    assert plan_seconds([3, 3, 4, 5], 2) == 8
    assert plan_seconds([3, 3, 5, 9], 2) == 12
    assert plan_seconds([9, 5, 3, 3], 2) == 11
    assert plan_seconds([5, 4], 1) == 9
    assert plan_seconds([], 3) == 0


def test_times_have_few_digits():
    assert time_text(math.nan) == time_text(math.inf) == time_text(1e10), "from a damaged file"
    assert time_text(float("inf")).endswith(" min")
    assert [time_text(seconds) for seconds in (0.4, 40, 100, 5900, 6100)] == ["0 s", "40 s", "2 min", "98 min", "1 h 42 min"]


def test_a_budget_of_minutes_is_its_own_estimate(tmp_path):
    plan = fake_plan(tmp_path, "minutes", systems=("papers_recipe-2", "papers_recipe-20", "ours-2"))
    known = durations_of(plan, tmp_path)
    assert [(known.of(job).source, known.of(job).train_s) for job in plan.jobs] == [("budget", s) for s in (240, 2400, 240)]
    assert longest_first(plan.jobs, known)[0].row == "papers_recipe-20"
    assert len({job.kind for job in plan.jobs}) == 3, "the settings of the first two differ in their budget alone"
    fake_run(plan.jobs[0], {"id": 0.9, "ood": 0.8}, spent_s={"speed": 100.0, "train": 300.0, "id": 30.0, "ood": 10.0})
    assert durations_of(plan, tmp_path).of(plan.jobs[0]).train_s == 400, "with the measurement of the speed"
