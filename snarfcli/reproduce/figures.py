"""The figures of a report: systems beside the ground truth, skinning weights in colour, and curves.

Matplotlib is imported inside functions: it takes half a second, and most calls draw nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError
from snarfcli.evaluation.evaluate import choose_frames
from snarfcli.evaluation.report import STORE_SPLITS
from snarfcli.files import atomic_path
from snarfcli.meshing.colors import weights_to_colors
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import canonical_surface, field_surface
from snarfcli.progress import progress
from snarfcli.rendering import Camera, contact_sheet, render, write_png
from snarfcli.reproduce.experiments import Row
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import COLUMNS, Result, look_up, read_metrics, summarise
from snarfcli.reproduce.stick2d_figures import draw_curves, draw_shapes, extreme_poses
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.texts import one_line

__all__ = ["draw_sequences", "draw_stick_curves", "draw_stick_shapes", "draw_systems", "draw_weights"]

log = logging.getLogger(__name__)

_PANEL = 256
_FRAMES = {"id": 2, "ood": 4}
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*", "h", "<", ">", "d")
# Subjects of the 2D stick: for extrapolation by setting, for interpolation by the step of the training angles in degrees.
_STICKS = {"stick": "two bones", "stick_object": "two bones + object"}
_STICK_STEPS = {"stick_step10": 10.0, "stick_step20": 20.0, "stick_step30": 30.0, "stick_step60": 60.0}
_CANONICAL_AZIMUTH_RAD = 0.35  # nearly from the front


def draw_systems(plan: Plan, results: Sequence[Result], folder: Path, resolution: int) -> tuple[Path, str] | None:
    """Draw frames in and out of distribution, one row each: ground truth, then each system (SNARF Fig. 6, Fast-SNARF Fig. 5).

    Args:
        plan: the plan.
        results: its runs. All drawn runs are of the subject and seed for which most systems are trained.
        folder: folder for the picture.
        resolution: voxels along the longest side of the meshes.

    Returns:
        File and caption; None if there is nothing to draw.
    """
    shown = _trained(plan, results)
    if not shown:
        return None
    first = shown[0][1]
    frames = [(split, *frame) for split, count in _FRAMES.items() for frame in _frames(first, split, count)]
    if not frames:
        return None
    rows: list[list[np.ndarray | None]] = [[] for _ in frames]
    truths = [Mesh(sequence.vertices(index), sequence.faces(index)) for _, sequence, index in frames]
    cameras = [Camera.framing(truth.vertices) for truth in truths]
    for row, truth, camera in zip(rows, truths, cameras, strict=True):
        row.append(render(truth, camera, _PANEL))
    for _, result in progress(shown, desc="drawing systems", unit="systems"):
        avatar = _load(result)
        for row, truth, camera, (_, sequence, index) in zip(rows, truths, cameras, frames, strict=True):
            mesh = None if avatar is None else _predicted(avatar, sequence, index, resolution)
            floor_y = float(truth.vertices[:, 1].min())
            row.append(None if mesh is None else render(mesh, camera, _PANEL, floor_y=floor_y))
    where = {"id": "in distribution", "ood": "out of distribution"}
    sheet = contact_sheet(
        rows,
        row_labels=[f"{where[split]}: {sequence.name}, frame {sequence.frame_numbers[i]}" for split, sequence, i in frames],
        column_labels=["ground truth", *(row.label for row, _ in shown)],
    )
    path = folder / "systems.png"
    write_png(path, sheet)
    seed = first.job.seed
    return path, f"Frames in and out of distribution, subject {first.job.subject}, seed {seed}; empty: the field has no surface"


def draw_weights(plan: Plan, results: Sequence[Result], folder: Path, resolution: int) -> tuple[Path, str] | None:
    """Draw canonical surfaces coloured by their skinning weights; ground-truth weights first (Fast-SNARF Fig. 6).

    Arguments and result: as `draw_systems`. Systems without weights of canonical points are left out.
    """
    shown = _trained(plan, results)
    pictures: list[np.ndarray] = []
    labels: list[str] = []
    if not shown:
        return None
    template = _store(shown[0][1], "id").template
    camera = None
    if template is not None:
        camera = Camera.framing(template.vertices, azimuth_rad=_CANONICAL_AZIMUTH_RAD)
        truth = Mesh(template.vertices, template.faces, colors=weights_to_colors(template.weights))
        pictures.append(render(truth, camera, _PANEL))
        labels.append("ground truth")
    for row, result in shown:
        avatar = _load(result)
        if avatar is None or not (avatar.has_skinning_weights and avatar.model.has_canonical_shape):
            continue
        try:
            mesh = canonical_surface(avatar, avatar.skeleton.canonical_pose.float(), resolution)
        except ValueError as error:
            log.warning("warning: cannot draw the weights of %s: %s", row.label, error)
            continue
        camera = camera or Camera.framing(mesh.vertices, azimuth_rad=_CANONICAL_AZIMUTH_RAD)
        assert mesh.weights is not None  # the avatar has skinning weights
        pictures.append(render(replace(mesh, colors=weights_to_colors(mesh.weights)), camera, _PANEL))
        labels.append(row.label)
    if not pictures:
        return None
    path = folder / "weights.png"
    write_png(path, contact_sheet([pictures], column_labels=labels))
    return path, f"Skinning weights, one colour per bone, subject {shown[0][1].job.subject}, seed {shown[0][1].job.seed}"


def draw_sequences(plan: Plan, results: Sequence[Result], folder: Path) -> tuple[Path, str] | None:
    """Draw the surface IoU of every out-of-distribution sequence, mean over runs, one line per system.

    Arguments and result: as `draw_systems`. Rows with missing runs are left out, since a mean over fewer runs would mislead.
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
    axis.grid(color="#DDDDDD", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False)
    path = folder / "sequences.png"
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130, facecolor="white")
    return path, "Surface IoU of each out-of-distribution sequence, mean over subjects and seeds"


def draw_stick_shapes(plan: Plan, results: Sequence[Result], folder: Path) -> tuple[Path, str] | None:
    """Draw the sticks out of distribution: ground truth and each system (SNARF Fig. 4).

    Arguments and result: as `draw_systems`.
    """
    rows = []
    for subject in (one for one in _STICKS if one in plan.subjects):
        of_subject = [result for result in results if result.job.subject == subject and result.job.seed == plan.seeds[0]]
        trained = {result.job.row: result for result in of_subject if "train" in result.files}
        if trained:
            avatars = {row.label: _load(trained[row.key]) if row.key in trained else None for row in plan.experiment.rows}
            rows += extreme_poses(_store(next(iter(trained.values())), "ood"), subject, avatars)
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


def _trained(plan: Plan, results: Sequence[Result]) -> list[tuple[Row, Result]]:
    """Return rows with a trained run each, all of one subject and seed: those for which most rows are trained."""
    trained = [result for result in results if "train" in result.files]
    if not trained:
        return []
    counts: dict[tuple[str, int], int] = {}
    for result in trained:
        key = (result.job.subject, result.job.seed)
        counts[key] = counts.get(key, 0) + 1
    chosen = max(counts, key=lambda key: counts[key])  # the first of several equals
    of_row = {result.job.row: result for result in trained if (result.job.subject, result.job.seed) == chosen}
    return [(row, of_row[row.key]) for row in plan.experiment.rows if row.key in of_row]


def _load(result: Result) -> Avatar | None:
    """Return the avatar of a run; None, with a warning, if it cannot be read. Its panel then stays empty."""
    try:
        return Avatar.load(result.job.folder)
    except UserError as error:
        log.warning("warning: cannot draw %s: %s", result.job.name, error)
        return None


def _store(result: Result, split: str) -> SampleStore:
    """Return the samples of a split on which a run is evaluated."""
    evaluation = next(one for one in result.job.evaluations if one.split == split)
    return SampleStore.open(evaluation.data_root, evaluation.data, result.job.subject)


def _frames(result: Result, split: str, count: int) -> Iterator[tuple[SequenceSamples, int]]:
    """Yield frames of a split, evenly spaced over its sequences; no frame if the data set has no such split."""
    try:
        sequences = _store(result, split).sequences(STORE_SPLITS[split])
    except UserError:
        return
    yield from choose_frames(sequences, count)


def _predicted(avatar: Avatar, sequence: SequenceSamples, index: int, resolution: int) -> Mesh | None:
    pose, translation, transforms = (
        torch.as_tensor(values[index]) for values in (sequence.poses, sequence.translation, sequence.bone_transforms)
    )
    try:
        return field_surface(avatar, pose, translation, resolution, transforms=transforms)
    except ValueError as error:
        log.warning("warning: no surface for %s, frame %d: %s", sequence.name, sequence.frame_numbers[index], error)
        return None
