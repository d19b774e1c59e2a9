"""The two figures of the 2D stick: shapes in extreme poses (SNARF Fig. 4), and IoU by setting and by step (SNARF Fig. 5).

Matplotlib is imported inside functions: it takes half a second, and most calls draw nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from snarfcli.bodies import Skeleton
from snarfcli.evaluation.evaluate import predict_inside
from snarfcli.evaluation.metrics import iou
from snarfcli.files import atomic_path
from snarfcli.models.trained_field import TrainedField
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import in_turned_over, winding_numbers

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["StickPose", "draw_curves", "draw_shapes", "extreme_poses"]

# The colours of Okabe and Ito, distinct also for colour-blind readers; the marks are distinct in print.
_COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442")
_MARKS = ("o", "s", "^", "D", "v", "P", "X")
_TRUTH_COLOR, _TRUTH_LINE, _BONE_COLOR = "#B8B8B8", "#D55E00", "black"
_FILL, _LINE = "#9FCBE6", "#0072B2"
_PANEL_INCHES = 1.9
_DPI = 160
_LOGIT_LIMIT = 2.0  # logits are clipped before contouring; larger ones do not change the zero level
_OUTLINE_WIDTH = 1.0
_SPACE = 1.16  # side of a panel, relative to the longest side of a shape
_NO_RESULT = "no result"


@dataclass(frozen=True)
class StickPose:
    """One row of `draw_shapes`."""

    label: str
    """Name of the row, such as the subject."""
    skeleton: Skeleton
    """Skeleton of the subject."""
    sequence: SequenceSamples
    """Samples of a planar subject."""
    frame: int
    """Index of the frame in the sequence."""
    avatars: Mapping[str, TrainedField | None]
    """Avatar of the subject by the label of the system; None or left out without an avatar."""


def extreme_poses(
    store: SampleStore, label: str, avatars: Mapping[str, TrainedField | None], count: int = 2
) -> list[StickPose]:
    """Choose out-of-distribution poses for `draw_shapes`: from each part of the frames the one with the largest overlap.

    Args:
        store: samples of a planar subject with an out-of-distribution sequence.
        label: name of the rows.
        avatars: avatars of this subject, by the label of the system.
        count: number of poses.

    Raises:
        UserError: the store has no out-of-distribution sequence.
    """
    frames = [(sequence, index) for sequence in store.sequences("ood") for index in range(sequence.num_frames)]
    rows = []
    for stretch in np.array_split(np.arange(len(frames)), min(count, len(frames))):
        # Without overlap this is the first frame of the part.
        sequence, index = max((frames[number] for number in stretch), key=lambda frame: _overlap(*frame))
        rows.append(StickPose(label, store.skeleton, sequence, index, avatars))
    return rows


def draw_shapes(path: str | Path, rows: Sequence[StickPose], *, resolution: int = 300) -> None:
    """Write a picture with one row per pose: the ground truth, then each system with its IoU below.

    The IoU is that of the uniform samples of the frame, as in `snarf eval`. The true outline is orange, bones are black.

    Args:
        path: the picture; the suffix gives the format (png, svg, pdf). Written complete or not at all.
        rows: poses; the systems are those of all rows, in order of first appearance.
        resolution: lattice points along each side of a panel.

    Raises:
        ValueError: there are no rows.
        OSError: the file cannot be written.

    Source: SNARF Fig. 4.
    """
    if not rows:
        raise ValueError("rows: wanted at least one pose, got none")
    systems = list(dict.fromkeys(name for row in rows for name in row.avatars))
    figure, axes = _figure(len(rows), 1 + len(systems))
    half = max(float(np.max(row.sequence.box(row.frame)[1] - row.sequence.box(row.frame)[0])) for row in rows) * _SPACE / 2
    for row, line in zip(rows, axes, strict=True):
        lattice, x, y = _lattice(row, half, resolution)
        truth = np.where(_true_inside(row, lattice), 1.0, -1.0).reshape(resolution, resolution)
        for axis, name in zip(line, [None, *systems], strict=True):
            avatar = None if name is None else row.avatars.get(name)
            axis.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal", xticks=[], yticks=[])
            for side in axis.spines.values():
                side.set_visible(False)
            if name is None:
                axis.contourf(x, y, truth, [0, 2], colors=[_TRUTH_COLOR])
                axis.contour(x, y, truth, [0], colors=["#666666"], linewidths=_OUTLINE_WIDTH)
            elif avatar is None:
                axis.text(0.5, 0.5, _NO_RESULT, transform=axis.transAxes, ha="center", va="center", color="#666666")
                continue
            else:
                _draw_prediction(axis, row, avatar, lattice, x, y)
                axis.contour(x, y, truth, [0], colors=[_TRUTH_LINE], linewidths=_OUTLINE_WIDTH, linestyles="dashed")
            _draw_bones(axis, row)
        angles = np.rad2deg(row.sequence.poses[row.frame, 1:3, 2])
        line[0].set_ylabel(f"{row.label}\n{angles[0]:.0f}°, {angles[1]:.0f}°", fontsize=9)
    for axis, name in zip(axes[0], ["ground truth", *systems], strict=True):
        axis.set_title(_wrapped(name), fontsize=9)
    _save(figure, path)


def draw_curves(
    path: str | Path,
    extrapolation: Mapping[str, Mapping[str, float | None]],
    interpolation: Mapping[str, Sequence[tuple[float, float | None]]],
) -> None:
    """Write a picture: on the left bars of the IoU out of distribution, on the right the IoU over the step of training angles.

    Args:
        path: the picture; the suffix gives the format (png, svg, pdf). Written complete or not at all.
        extrapolation: for each system, by its label, the IoU (0 to 1) in each setting, such as "two bones" and "two bones +
            object". None for a failed run, which a text marks in place of the bar.
        interpolation: for each system the steps, degrees, and the IoU (0 to 1) at each; None leaves a gap in the curve.

    Raises:
        ValueError: there is nothing to draw.
        OSError: the file cannot be written.

    Source: SNARF Fig. 5.
    """
    systems = list(dict.fromkeys([*extrapolation, *interpolation]))
    settings = list(dict.fromkeys(setting for values in extrapolation.values() for setting in values))
    if not systems or not (settings or any(interpolation.values())):
        raise ValueError("extrapolation, interpolation: wanted at least one value, got none")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    bars, curves = figure.subplots(1, 2, width_ratios=(1.15, 1))
    width = 0.84 / max(1, len(systems))
    for number, name in enumerate(systems):
        color, mark = _COLORS[number % len(_COLORS)], _MARKS[number % len(_MARKS)]
        for place, setting in enumerate(settings):
            left = place + (number - (len(systems) - 1) / 2) * width
            _draw_bar(bars, left, width, extrapolation.get(name, {}).get(setting), color)
        steps = sorted(interpolation.get(name, ()), key=lambda point: point[0])
        values = [np.nan if value is None else 100 * value for _, value in steps]
        curves.plot([step for step, _ in steps], values, color=color, marker=mark, label=name, linewidth=1.6, markersize=5)
    bars.set(xticks=range(len(settings)), xticklabels=settings, ylim=(0, 109), yticks=range(0, 101, 20), ylabel="IoU, %")
    bars.set_title("extrapolation: angles of 60° to 120°", fontsize=10)
    bars.tick_params(axis="x", length=0)
    curves.set(xlabel="step of the training angles, degrees", ylabel="IoU, %")
    curves.set_xticks(sorted({step for points in interpolation.values() for step, _ in points}))
    curves.set_title("interpolation: angles within 60°", fontsize=10)
    for axis in (bars, curves):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="y", color="#DDDDDD", linewidth=0.8)
        axis.set_axisbelow(True)
    figure.legend(*curves.get_legend_handles_labels(), loc="outside lower center", ncols=min(4, len(systems)), frameon=False)
    _save(figure, path)


def _draw_bar(axis: Axes, centre: float, width: float, value: float | None, color: str) -> None:
    """Draw a bar with its value in per cent above it, or the text "no result"."""
    height = 100 * value if value is not None and np.isfinite(value) else None
    axis.bar(centre, height or 0.0, 0.94 * width, color=color)
    text, rotation = (_NO_RESULT, 90) if height is None else (f"{height:.1f}", 0)
    axis.text(centre, (height or 0.0) + 1.2, text, ha="center", va="bottom", fontsize=8, rotation=rotation)


def _figure(height: int, width: int) -> tuple[Any, np.ndarray]:
    """Return a figure with panels, and its axes [height, width]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_PANEL_INCHES * width + 0.4, (_PANEL_INCHES + 0.25) * height + 0.3), layout="constrained")
    return figure, figure.subplots(height, width, squeeze=False)


def _save(figure: Any, path: str | Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=_DPI, facecolor="white")


def _wrapped(name: str) -> str:
    """Return a label with a line break before a bracket, so that neighbouring titles stay apart."""
    return name.replace(" (", "\n(")


def _lattice(row: StickPose, half: float, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lattice points [R * R, 3] of a square around a pose, with their x [R] and y [R], metres."""
    lower, upper = row.sequence.box(row.frame)
    centre = (lower + upper) / 2
    x, y = (np.linspace(centre[axis] - half, centre[axis] + half, resolution) for axis in (0, 1))
    flat = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return np.column_stack([flat, np.zeros(len(flat))]).astype(np.float32), x, y


def _true_inside(row: StickPose, points: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] of the plane are inside, labelled as in the samples, bool [N]."""
    vertices, faces = row.sequence.vertices(row.frame), row.sequence.faces(row.frame)
    return (winding_numbers(vertices, faces, points) > 0.5) | in_turned_over(vertices, faces, points)


def _overlap(sequence: SequenceSamples, index: int) -> int:
    """Return the number of uniform points in overlapping parts."""
    points = sequence.points(index, np.arange(sequence.num_uniform))
    return int((winding_numbers(sequence.vertices(index), sequence.faces(index), points) > 1.5).sum())


def _draw_prediction(
    axis: Axes, row: StickPose, avatar: TrainedField, lattice: np.ndarray, x: np.ndarray, y: np.ndarray
) -> None:
    """Fill the inside of an avatar, and write the IoU of the frame below."""
    posed = (row.sequence.bone_transforms, row.sequence.poses)
    transforms, pose = (torch.as_tensor(values[row.frame])[None] for values in posed)
    logits = avatar.query(torch.as_tensor(lattice)[None], transforms, pose).logits[0].detach().cpu().numpy()
    values = logits.clip(-_LOGIT_LIMIT, _LOGIT_LIMIT).reshape(len(y), len(x))
    if values.max() > 0:
        axis.contourf(x, y, values, [0, _LOGIT_LIMIT + 1], colors=[_FILL])
        axis.contour(x, y, values, [0], colors=[_LINE], linewidths=_OUTLINE_WIDTH)
    uniform = np.arange(row.sequence.num_uniform)
    inside = predict_inside(avatar, row.sequence, row.frame, row.sequence.points(row.frame, uniform))
    share = iou(inside, row.sequence.occupancies(row.frame, uniform))
    axis.set_xlabel(f"IoU {100 * float(share):.1f} %", fontsize=9)


def _draw_bones(axis: Axes, row: StickPose) -> None:
    joints = row.sequence.joints[row.frame]
    for parent, joint in row.skeleton.bones:
        axis.plot(*joints[[parent, joint], :2].T, color=_BONE_COLOR, linewidth=1.2, solid_capstyle="round")
    axis.plot(*joints[:, :2].T, linestyle="none", marker="o", markersize=2.5, color=_BONE_COLOR)
