"""Curves over the time of training: means over runs, which clock counts, and which rows are left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_runs import FAKE_MACHINE, fake_plan, fake_run, read
from PIL import Image

from snarfcli.files import write_json
from snarfcli.reproduce import line_figures
from snarfcli.reproduce.line_figures import draw_sequences, draw_training, training_curves
from snarfcli.reproduce.plans import Job
from snarfcli.reproduce.results import collect


def validated(job: Job, steps: list, seconds: Any, surface: Any, ood: float | None = None, clock: float | None = 0.5) -> None:
    """Write a run whose training has validations; a step takes `clock` of its wall time on one core, None for unknown."""
    fake_run(job, {"id": 0.9, "ood": 0.8})
    path = Path(job.folder) / "metrics.json"
    rows = [
        {"step": step, "seconds": second, "iou_bbox": 0.9, "iou_surface": iou}
        | ({} if clock is None else {"processor_s": clock * second})
        | ({} if ood is None else {"ood_iou_surface": iou - ood})
        for step, second, iou in zip(steps, seconds, surface, strict=True)
    ]
    write_json(path, read(path) | {"validations": rows})


@pytest.fixture
def figures(monkeypatch):
    """The figures at the time of saving."""
    saved = []
    save = line_figures._save
    monkeypatch.setattr(line_figures, "_save", lambda figure, *rest: (saved.append(figure), save(figure, *rest)))
    return saved


def test_a_curve_is_the_mean_over_runs_after_the_same_share_of_their_steps(tmp_path):
    plan = fake_plan(tmp_path, "minutes", systems=("ours-2",), seeds=(0, 1))
    first, second = plan.jobs
    validated(first, [10, 20], [60, 120], [0.5, 0.7], ood=0.2)
    validated(second, [5, 10, 20, 40], [30, 60, 120, 240], [0.1, 0.2, 0.3, 0.5], ood=0.2)
    ((row, curve),), clock = training_curves(plan, [collect(job) for job in plan.jobs])
    assert (row.key, clock) == ("ours-2", "minutes of one core")
    np.testing.assert_allclose(curve.minutes, [(0.5 + 1.0) / 2, (1.0 + 2.0) / 2])
    np.testing.assert_allclose(curve.iou["in"], [(50 + 30) / 2, (70 + 50) / 2])
    np.testing.assert_allclose(curve.iou["out"], curve.iou["in"] - 20)


def test_rows_without_all_runs_are_left_out_and_the_wall_time_counts_if_one_has_no_other(tmp_path):
    plan = fake_plan(tmp_path, systems=("nasa", "snarf", "ours-local"), seeds=(0, 1))
    for job in plan.jobs:
        if (job.row, job.seed) != ("snarf", 1):
            validated(job, [10, 20], [60, 120], [0.5, 0.7], clock=None if job.row == "ours-local" else 0.5)
    curves, clock = training_curves(plan, [collect(job) for job in plan.jobs])
    assert [row.key for row, _ in curves] == ["nasa", "ours-local"]
    assert clock == "minutes"
    for _, curve in curves:
        np.testing.assert_allclose(curve.minutes, [1, 2])
        assert set(curve.iou) == {"in"}, "not measured out of distribution"


def test_on_a_gpu_the_wall_time_counts(tmp_path):
    plan = fake_plan(tmp_path, systems=("nasa", "snarf"))
    for job in plan.jobs:
        validated(job, [10, 20], [60, 120], [0.5, 0.7])
    path = Path(plan.jobs[1].folder) / "metrics.json"
    write_json(path, read(path) | {"machine": FAKE_MACHINE | {"gpu": "a GPU"}})
    curves, clock = training_curves(plan, [collect(job) for job in plan.jobs])
    assert clock == "minutes"
    for _, curve in curves:
        np.testing.assert_allclose(curve.minutes, [1, 2])


def test_damaged_or_missing_validations_draw_nothing(tmp_path):
    plan = fake_plan(tmp_path, systems=("nasa",))
    fake_run(plan.jobs[0], {"id": 0.9, "ood": 0.8})
    assert draw_training(plan, [collect(plan.jobs[0])], tmp_path / "figures") is None
    path = Path(plan.jobs[0].folder) / "metrics.json"
    write_json(path, read(path) | {"validations": [{"step": 3, "seconds": "many", "iou_surface": 0.4}]})
    assert draw_training(plan, [collect(plan.jobs[0])], tmp_path / "figures") is None
    assert not (tmp_path / "figures").exists()


def test_recipes_with_several_budgets_have_one_colour_each_on_a_logarithmic_axis(tmp_path, figures):
    plan = fake_plan(tmp_path, "minutes")
    for job in plan.jobs:
        end = 60 * (job.minutes or 0)
        level = {"papers_recipe": 0.5, "ours_networks": 0.6, "ours": 0.8}[job.row.rpartition("-")[0]]
        shares = np.arange(1, 5) / 4
        validated(job, [10, 20, 30, 40], shares * end, level + 0.1 * shares, ood=0.05, clock=1.0)
    results = [collect(job) for job in plan.jobs]
    drawn = draw_training(plan, results, tmp_path / "figures")
    assert drawn is not None
    path, caption = drawn
    assert "mean over subjects and seeds" in caption
    assert Image.open(path).size[0] > 1200
    inside, outside = figures[0].axes
    assert [len(axis.lines) for axis in (inside, outside)] == [9, 9]
    assert inside.get_xscale() == "log"
    assert inside.get_xlabel() == "training, minutes of one core"
    colours = [line.get_color() for line in inside.lines]
    assert colours == [colours[0]] * 3 + [colours[3]] * 3 + [colours[6]] * 3
    assert len(set(colours)) == 3
    assert len({line.get_linestyle() for line in inside.lines[:3]}) == 3
    np.testing.assert_allclose(outside.lines[8].get_xydata()[-1], [40, 85])
    assert [text.get_text() for text in figures[0].legends[0].get_texts()] == [row.label for row in plan.experiment.rows]


def test_sequences_are_sorted_from_the_easiest(tmp_path, figures):
    plan = fake_plan(tmp_path, systems=("nasa", "ours-local"))
    for job in plan.jobs:
        fake_run(job, {"id": 0.9, "ood": 0.8})
        metrics = read(Path(job.evaluations[1].metrics))
        metrics["sequences"]["kicks"]["iou_surface"] = 0.3
        write_json(job.evaluations[1].metrics, metrics)
    drawn = draw_sequences(plan, [collect(job) for job in plan.jobs], tmp_path / "figures")
    assert drawn is not None
    assert drawn[0].is_file()
    (axis,) = figures[0].axes
    assert [text.get_text() for text in axis.get_xticklabels()] == ["splits", "kicks"]
    np.testing.assert_allclose(axis.lines[0].get_ydata(), [80, 30])
