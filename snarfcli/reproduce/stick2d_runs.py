"""From the runs of the 2D stick to its figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from snarfcli.reproduce.drawn_runs import load_avatar, open_samples
from snarfcli.reproduce.experiments import Row
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import COLUMNS, Result, summarise
from snarfcli.reproduce.stick2d_figures import draw_curves, draw_shapes, extreme_poses

__all__ = ["draw_stick_curves", "draw_stick_shapes"]

# Subjects of the 2D stick: for extrapolation by setting, for interpolation by the step of the training angles in degrees.
_STICKS = {"stick": "two bones", "stick_object": "two bones + object"}
_STICK_STEPS = {"stick_step10": 10.0, "stick_step20": 20.0, "stick_step30": 30.0, "stick_step60": 60.0}


def draw_stick_shapes(plan: Plan, results: Sequence[Result], folder: Path) -> tuple[Path, str] | None:
    """Draw the sticks out of distribution: ground truth and each system (SNARF Fig. 4).

    Arguments and result: as `draw_systems`.
    """
    rows = []
    for subject in (one for one in _STICKS if one in plan.subjects):
        of_subject = [result for result in results if result.job.subject == subject and result.job.seed == plan.seeds[0]]
        trained = {result.job.row: result for result in of_subject if "train" in result.files}
        if trained:
            avatars = {row.label: load_avatar(trained[row.key]) if row.key in trained else None for row in plan.experiment.rows}
            rows += extreme_poses(open_samples(next(iter(trained.values())), "ood"), subject, avatars)
    if not rows:
        return None
    draw_shapes(folder / "shapes.png", rows)
    return folder / "shapes.png", f"Sticks out of distribution, seed {plan.seeds[0]} (as SNARF Fig. 4)"


def draw_stick_curves(plan: Plan, results: Sequence[Result], folder: Path) -> tuple[Path, str] | None:
    """Draw the IoU of the sticks out of distribution, and over the step of the training angles (SNARF Fig. 5).

    Arguments and result: as `draw_systems`. A number with missing runs is drawn as missing.
    """
    columns = {column.key: column for column in COLUMNS}

    def value(row: Row, subject: str, key: str) -> float | None:
        some = [result for result in results if result.job.row == row.key and result.job.subject == subject]
        cell = summarise(some, columns[key])
        return None if cell.mean is None or cell.unknown else cell.mean / 100

    extrapolation, interpolation = {}, {}
    for row in plan.experiment.rows:
        there = {subject: name for subject, name in _STICKS.items() if subject in plan.subjects}
        extrapolation[row.label] = {name: value(row, subject, "bbox_ood") for subject, name in there.items()}
        steps = {subject: step for subject, step in _STICK_STEPS.items() if subject in plan.subjects}
        interpolation[row.label] = [(step, value(row, subject, "bbox_id")) for subject, step in steps.items()]
    draw_curves(folder / "curves.png", extrapolation, interpolation)
    return folder / "curves.png", "IoU of uniform points, mean over seeds (as SNARF Fig. 5)"
