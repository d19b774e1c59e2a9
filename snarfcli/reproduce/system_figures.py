"""Pictures of the systems of a table: frames beside the ground truth, and skinning weights in colour."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from snarfcli.errors import UserError
from snarfcli.evaluation.evaluate import choose_frames
from snarfcli.evaluation.report import STORE_SPLITS
from snarfcli.meshing.colors import weights_to_colors
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import canonical_surface
from snarfcli.progress import progress
from snarfcli.rendering import Camera, contact_sheet, render, write_png
from snarfcli.reproduce.drawn_runs import load_avatar, open_samples, predicted_surface, trained_runs
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import Result
from snarfcli.samples.sequence import SequenceSamples

__all__ = ["draw_systems", "draw_weights"]

log = logging.getLogger(__name__)

_PANEL = 256
_FRAMES = {"id": 2, "ood": 4}
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
    shown = trained_runs(plan, results)
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
        avatar = load_avatar(result)
        for row, truth, camera, (_, sequence, index) in zip(rows, truths, cameras, frames, strict=True):
            mesh = None if avatar is None else predicted_surface(avatar, sequence, index, resolution)
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
    shown = trained_runs(plan, results)
    pictures: list[np.ndarray] = []
    labels: list[str] = []
    if not shown:
        return None
    template = open_samples(shown[0][1], "id").template
    camera = None
    if template is not None:
        camera = Camera.framing(template.vertices, azimuth_rad=_CANONICAL_AZIMUTH_RAD)
        truth = Mesh(template.vertices, template.faces, colors=weights_to_colors(template.weights))
        pictures.append(render(truth, camera, _PANEL))
        labels.append("ground truth")
    for row, result in shown:
        avatar = load_avatar(result)
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


def _frames(result: Result, split: str, count: int) -> Iterator[tuple[SequenceSamples, int]]:
    """Yield frames of a split, evenly spaced over its sequences; no frame if the data set has no such split."""
    try:
        sequences = open_samples(result, split).sequences(STORE_SPLITS[split])
    except UserError:
        return
    yield from choose_frames(sequences, count)
