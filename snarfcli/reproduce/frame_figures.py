"""A picture of the worst and of a typical out-of-distribution frame of each system, beside the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError
from snarfcli.evaluation.report import STORE_SPLITS
from snarfcli.meshing.mesh import Mesh
from snarfcli.progress import progress
from snarfcli.rendering import Camera, contact_sheet, render, write_png
from snarfcli.reproduce.drawn_runs import load_avatar, open_samples, predicted_surface, trained_runs
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import Result, read_metrics
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.texts import one_line

__all__ = ["MeasuredFrame", "draw_frames", "worst_and_typical"]

_PANEL = 224
_COLUMNS = ("ground truth", "worst frame", "ground truth", "typical frame")


@dataclass(frozen=True)
class MeasuredFrame:
    """A frame of an evaluation."""

    sequence: str
    """Name of the sequence."""
    number: int
    """Number of the frame in the motion."""
    iou: float
    """Surface IoU, 0 to 1."""


def draw_frames(plan: Plan, results: Sequence[Result], folder: Path, resolution: int) -> tuple[Path, str] | None:
    """Draw the out-of-distribution frame with the lowest surface IoU of each system, and the one with the median.

    Args:
        plan: the plan.
        results: its runs. All drawn runs are of the subject and seed for which most systems are trained.
        folder: folder for the picture.
        resolution: voxels along the longest side of the meshes.

    Returns:
        File and caption; None if there is nothing to draw.
    """
    shown = [(row, result) for row, result in trained_runs(plan, results) if "ood" in result.files]
    rows: list[list[np.ndarray | None]] = []
    captions: list[list[str | None]] = []
    labels: list[str] = []
    for row, result in progress(shown, desc="drawing frames", unit="systems"):
        chosen = worst_and_typical(_measured(result.files["ood"]))
        if chosen is None:
            continue
        sequences, avatar = open_samples(result, "ood").sequences(STORE_SPLITS["ood"]), load_avatar(result)
        parts = [_draw(avatar, sequences, frame, resolution) for frame in chosen]
        rows.append([picture for pictures, _ in parts for picture in pictures])
        captions.append([caption for _, own in parts for caption in own])
        labels.append(row.label)
    if not rows:
        return None
    path, job = folder / "frames.png", shown[0][1].job
    write_png(path, contact_sheet(rows, row_labels=labels, column_labels=_COLUMNS, captions=captions))
    what = "Each system's out-of-distribution frames with the lowest and with the median surface IoU"
    return path, f"{what}, subject {job.subject}, seed {job.seed}; empty: the field has no surface"


def worst_and_typical(frames: Sequence[MeasuredFrame]) -> tuple[MeasuredFrame, MeasuredFrame] | None:
    """Return the frame with the lowest IoU and that with the median (the lower of two in the middle); None without frames."""
    order = sorted(frames, key=lambda frame: (frame.iou, frame.sequence, frame.number))
    return (order[0], order[(len(order) - 1) // 2]) if order else None


def _measured(path: Path) -> list[MeasuredFrame]:
    """Return the frames of an evaluation for which its file has both numbers."""
    frames = []
    for name, sequence in read_metrics(path).sequences.items():
        of_frames = sequence.get("per_frame")
        columns = [of_frames.get(key) if isinstance(of_frames, dict) else None for key in ("frame", "iou_surface")]
        for number, value in zip(*(column if isinstance(column, list) else [] for column in columns), strict=False):
            if type(number) is int and type(value) in (int, float):
                frames.append(MeasuredFrame(name, number, value))
    return frames


def _draw(
    avatar: Avatar | None, sequences: Sequence[SequenceSamples], frame: MeasuredFrame, resolution: int
) -> tuple[list[np.ndarray | None], list[str]]:
    """Return two pictures, of the ground truth and of the avatar, and their captions.

    Raises:
        UserError: the samples do not have the frame.
    """
    sequence = next((one for one in sequences if one.name == frame.sequence), None)
    found = [] if sequence is None else np.flatnonzero(np.asarray(sequence.frame_numbers) == frame.number)
    if sequence is None or not len(found):
        raise UserError(f"the samples have no frame {frame.number} of {one_line(frame.sequence, 60)} any more; evaluate again")
    index = int(found[0])
    truth = Mesh(sequence.vertices(index), sequence.faces(index))
    camera, floor_y = Camera.framing(truth.vertices), float(truth.vertices[:, 1].min())
    mesh = None if avatar is None else predicted_surface(avatar, sequence, index, resolution)
    pictures = [None if one is None else render(one, camera, _PANEL, floor_y=floor_y) for one in (truth, mesh)]
    return pictures, [f"{sequence.name}, frame {frame.number}", f"surface IoU {100 * frame.iou:.1f} %"]
