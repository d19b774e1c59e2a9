"""Curves of the systems of a table: IoU over the time of training, and of each sequence.

Matplotlib is imported inside functions: it takes half a second, and most calls draw nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.files import atomic_path
from snarfcli.reproduce.experiments import Row
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import Metrics, Result, look_up, read_metrics
from snarfcli.texts import one_line

__all__ = ["Curve", "draw_sequences", "draw_training", "training_curves"]

_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*", "h", "<", ">", "d")
_DASHES = ("-", "--", ":", "-.")
_WIDE = 8.0  # the last time of the slowest row by the first of the fastest, from which the axis is logarithmic
_SPLITS = {"in": ("in distribution (held-back motion)", "iou_surface"), "out": ("out of distribution", "ood_iou_surface")}


@dataclass(frozen=True)
class Curve:
    """The validations of the trainings of one row, mean over its runs."""

    minutes: np.ndarray
    """[V], minutes of training before each validation."""
    iou: dict[str, np.ndarray]
    """[V] each, surface IoU in percent, by `in` and `out`; `out` is missing if the trainings did not measure it."""


def draw_training(plan: Plan, results: Sequence[Result], folder: Path) -> tuple[Path, str] | None:
    """Draw the surface IoU over the minutes of training, in and out of distribution, one line per row.

    Args:
        plan: the plan.
        results: its runs. Rows with a run that has no validations are left out, since a mean over fewer runs would mislead.
        folder: folder for the picture.

    Returns:
        File and caption; None if there is nothing to draw.
    """
    curves, clock = training_curves(plan, results)
    splits = [split for split in _SPLITS if any(split in curve.iou for _, curve in curves)]
    if not splits:
        return None
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(3.0 + 4.5 * len(splits), 4.5), layout="constrained")
    axes = figure.subplots(1, len(splits), sharex=True, sharey=True, squeeze=False)[0]
    styles = _styles([row for row, _ in curves])
    for axis, split in zip(axes, splits, strict=True):
        for (row, curve), style in zip(curves, styles, strict=True):
            if split in curve.iou:
                axis.plot(curve.minutes, curve.iou[split], label=row.label, linewidth=1.6, markersize=5, **style)
        axis.set_title(_SPLITS[split][0], fontsize=10)
        axis.set_xlabel(f"training, {clock}")
        _set_up(axis)
    axes[0].set_ylabel("surface IoU, %")
    times = np.concatenate([curve.minutes for _, curve in curves])
    if times.min() > 0 and times.max() > _WIDE * times.min():
        axes[0].set_xscale("log")
        axes[0].xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes[0].xaxis.set_major_formatter("{x:g}")
    _save(figure, axes[0], folder / "training.png")
    what = (
        "Surface IoU of validations on a few frames over the time of training, without validation; mean over subjects and seeds"
    )
    return folder / "training.png", what


def training_curves(plan: Plan, results: Sequence[Result]) -> tuple[list[tuple[Row, Curve]], str]:
    """Return the rows all of whose runs have validations, with their curves, and the unit of the time.

    The time is that of one core if all runs have recorded it and none used a GPU, and the wall time otherwise. Runs of a row
    can differ in their number of steps, so a mean is over validations after the same share of the steps.
    """
    metrics: list[tuple[Row, list[Metrics]]] = []
    for row in plan.experiment.rows:
        of_row = [result for result in results if result.job.row == row.key]
        known = [read_metrics(result.files["train"]) for result in of_row if "train" in result.files]
        if known and len(known) == len(of_row) and all(map(_is_measured, known)):
            metrics.append((row, known))
    runs = [run for _, some in metrics for run in some]
    has_processor_s = all(look_up(one, ("processor_s",)) is not None for run in runs for one in run.validations)
    clock = "processor_s" if has_processor_s and not any("gpu" in run.machine for run in runs) else "seconds"
    curves = [(row, _mean_curve(some, clock)) for row, some in metrics]
    return curves, "minutes of one core" if clock == "processor_s" else "minutes"


def _mean_curve(runs: Sequence[Metrics], clock: str) -> Curve:
    """Return the mean of the validations of several runs."""
    shares = [steps / max(steps.max(), 1) for steps in (_column(run, "step") for run in runs)]

    def mean(name: str) -> np.ndarray:
        # at the shares of the first run; linear in between, if those of others differ
        of_runs = [np.interp(shares[0], *pair) for pair in zip(shares, (_column(run, name) for run in runs), strict=True)]
        return np.mean(of_runs, 0)

    measured = {split: mean(name) * 100 for split, (_, name) in _SPLITS.items()}
    return Curve(mean(clock) / 60, {split: values for split, values in measured.items() if np.isfinite(values).all()})


def _is_measured(metrics: Metrics) -> bool:
    """Return whether a training has validations, each with what a curve needs."""
    names = ("step", "seconds", _SPLITS["in"][1])
    return bool(metrics.validations) and all(look_up(one, (name,)) is not None for one in metrics.validations for name in names)


def _column(metrics: Metrics, name: str) -> np.ndarray:
    """Return one number of each validation, NaN where it is missing."""
    values = [look_up(one, (name,)) for one in metrics.validations]
    return np.array([np.nan if value is None else value for value in values], float)


def _styles(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return colour, mark and dashes of each row; rows that differ in their budget of minutes alone have one colour."""
    styles, groups = [], {}
    for row in rows:
        group = row.key if row.minutes is None else row.key.rpartition("-")[0]
        same = groups.setdefault(group, [])
        number = list(groups).index(group)
        dashes = _DASHES[len(same) % len(_DASHES)]
        same.append(row.key)
        styles.append({"color": f"C{number % 10}", "marker": _MARKS[number % len(_MARKS)], "linestyle": dashes})
    return styles


def draw_sequences(plan: Plan, results: Sequence[Result], folder: Path) -> tuple[Path, str] | None:
    """Draw the surface IoU of every out-of-distribution sequence, mean over runs, one line per system.

    Arguments and result: as `draw_training`. Rows with missing runs are left out.
    """
    lines: dict[str, dict[str, float]] = {}
    for row in plan.experiment.rows:
        of_row = [result for result in results if result.job.row == row.key]
        if not of_row or not all("ood" in result.files for result in of_row):
            continue
        by_name: dict[str, list[float]] = {}
        for result in of_row:
            for name, sequence in read_metrics(result.files["ood"]).sequences.items():
                share = look_up(sequence, ("iou_surface",))
                if share is not None:
                    by_name.setdefault(one_line(name, 60), []).append(100 * share)
        lines[row.label] = {name: float(np.mean(some)) for name, some in by_name.items()}
    names = sorted({name for line in lines.values() for name in line})
    if len(names) < 2:
        return None
    # From the easiest to the hardest, by the mean of all systems.
    names.sort(key=lambda name: -np.mean([line[name] for line in lines.values() if name in line]))
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axis = figure.subplots()
    for number, (label, line) in enumerate(lines.items()):
        values = [line.get(name, np.nan) for name in names]
        axis.plot(names, values, label=label, linewidth=1.6, marker=_MARKS[number % len(_MARKS)], markersize=5)
    axis.set_ylabel("surface IoU, %")
    axis.tick_params(axis="x", rotation=25)
    _set_up(axis)
    _save(figure, axis, folder / "sequences.png")
    return folder / "sequences.png", "Surface IoU of each out-of-distribution sequence, mean over subjects and seeds"


def _set_up(axis: Any) -> None:
    axis.grid(color="#DDDDDD", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)


def _save(figure: Any, axis: Any, path: Path) -> None:
    """Write a figure with the legend of one of its axes beside it."""
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130, facecolor="white")
