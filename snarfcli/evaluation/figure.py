"""A picture of the worst and the best frames: ground truth, prediction and wrongly labelled points side by side."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from snarfcli.evaluation.evaluate import predict_inside
from snarfcli.evaluation.metrics import FrameMetrics
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import field_surface
from snarfcli.models.trained_field import TrainedField
from snarfcli.progress import progress
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.render import render
from snarfcli.rendering.sheet import contact_sheet, write_png
from snarfcli.samples.sequence import SequenceSamples

__all__ = ["EXTRA", "MISSING", "choose_extremes", "draw_frame", "write_figure"]

log = logging.getLogger(__name__)

MISSING = (214, 39, 40)
"""sRGB colour of points that are inside but were predicted to be outside."""
EXTRA = (31, 87, 200)
"""sRGB colour of points that are outside but were predicted to be inside."""

_PANEL = 320  # pixels
_STRETCHES = 8  # parts of a sequence; at most one frame per part is among the worst, and one among the best
_PALE = 225  # sRGB grey of the body under the points
_COLUMNS = ("ground truth", "prediction", "red: missing points, blue: extra points")


def choose_extremes(frames: Sequence[FrameMetrics], count: int) -> tuple[list[FrameMetrics], list[FrameMetrics]]:
    """Return the `count` worst frames, worst first, and the best ones, best first, by surface IoU.

    Neighbouring frames look alike, so each list has at most one frame per eighth of a sequence. No frame is in both lists; with
    few frames the worse half counts as the worst.
    """
    count = min(count, max(1, len(frames) // 2))
    length = {name: 1 + max(f.frame for f in frames if f.sequence == name) for name in {f.sequence for f in frames}}
    order = sorted(frames, key=lambda frame: (frame.iou_surface, frame.sequence, frame.frame))

    def pick(candidates: Sequence[FrameMetrics]) -> list[FrameMetrics]:
        chosen: dict[tuple[str, int], FrameMetrics] = {}
        for frame in candidates:
            stretch = (frame.sequence, frame.frame * _STRETCHES // length[frame.sequence])
            chosen.setdefault(stretch, frame)
        return list(chosen.values())[:count]

    worst = pick(order)
    best = pick([frame for frame in reversed(order) if frame not in worst])
    return worst, best


def write_figure(
    path: str | Path,
    avatar: TrainedField,
    sequences: Sequence[SequenceSamples],
    frames: Sequence[FrameMetrics],
    *,
    count: int = 3,
    resolution: int = 128,
    title: str = "",
) -> None:
    """Write a PNG with the worst frames on the left and the best on the right, by surface IoU. The file is whole or absent.

    Args:
        path: of the PNG.
        avatar: the measured avatar.
        sequences: samples that include all sequences named in `frames`.
        frames: measured frames.
        count: maximum number of worst frames, and of best frames.
        resolution: voxels along the longest side of the predicted meshes.
        title: of the figure; empty for none.
    """
    by_name = {sequence.name: sequence for sequence in sequences}
    worst, best = choose_extremes(frames, count)
    rows: list[list[np.ndarray | None]] = [[] for _ in worst]
    captions: list[list[str | None]] = [[] for _ in worst]
    chosen = [(row, frame) for group in (worst, best) for row, frame in enumerate(group)]
    for row, frame in progress(chosen, desc="drawing", unit="frames"):
        pictures, (missing, extra) = draw_frame(avatar, by_name[frame.sequence], frame.index, resolution=resolution)
        rows[row] += pictures
        captions[row] += [
            f"{frame.sequence}, frame {frame.frame}",
            f"IoU surface {100 * frame.iou_surface:.1f} %, bbox {100 * frame.iou_bbox:.1f} %"
            + ("" if pictures[1] is not None else " (no surface)"),
            f"{missing} missing, {extra} extra of {by_name[frame.sequence].num_points}",
        ]
    width = len(_COLUMNS) * (2 if best else 1)
    for row, caption in zip(rows, captions, strict=True):
        row += [None] * (width - len(row))
        caption += [None] * (width - len(caption))
    sides = [f"worst: {_COLUMNS[0]}", *_COLUMNS[1:], *([f"best: {_COLUMNS[0]}", *_COLUMNS[1:]] if best else [])]
    write_png(path, contact_sheet(rows, column_labels=sides, captions=captions, title=title or None))


def draw_frame(
    avatar: TrainedField, sequence: SequenceSamples, index: int, *, resolution: int, size: int = _PANEL
) -> tuple[list[np.ndarray | None], tuple[int, int]]:
    """Draw one frame from one camera: ground truth, prediction and wrongly labelled points.

    Args:
        avatar: the predicting avatar.
        sequence: samples.
        index: frame index.
        resolution: voxels along the longest side of the predicted mesh.
        size: pixels along each side of a picture.

    Returns:
        Three pictures [size, size, 3] uint8, sRGB, where the prediction is None if the field has no surface; and the numbers of
        missing and of extra points.
    """
    truth = Mesh(sequence.vertices(index), sequence.faces(index))
    camera = Camera.framing(truth.vertices)
    floor_y = float(truth.vertices[:, 1].min())
    pose, translation = (torch.as_tensor(values[index]) for values in (sequence.poses, sequence.translation))
    try:
        transforms = torch.as_tensor(sequence.bone_transforms[index])
        predicted = field_surface(avatar, pose, translation, resolution, transforms=transforms)
    except ValueError as error:
        log.warning("warning: nothing to draw for %s, frame %d: %s", sequence.name, sequence.frame_numbers[index], error)
        predicted = None
    pale = replace(truth, colors=np.full(truth.vertices.shape, _PALE, np.uint8))
    true_picture, wrong_points = (render(mesh, camera, size, floor_y=floor_y) for mesh in (truth, pale))
    prediction = None if predicted is None else render(predicted, camera, size, floor_y=floor_y)
    points, occupied = sequence.points(index), sequence.occupancies(index)
    inside = predict_inside(avatar, sequence, index, points)
    missing, extra = occupied & ~inside, inside & ~occupied
    for wrong, color in ((extra, EXTRA), (missing, MISSING)):
        wrong_points = _draw_points(wrong_points, camera.project(points[wrong], size, size), color)
    return [true_picture, prediction, wrong_points], (int(missing.sum()), int(extra.sum()))


def _draw_points(picture: np.ndarray, projected: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Draw discs over a picture, also where a surface hides them, as most missing points lie below it.

    Args:
        picture: [H, W, 3] uint8.
        projected: [N, 3] pixel coordinates and depth.
        color: sRGB, 0 to 255.
    """
    scale = 4  # drawn larger and reduced, since PIL does not smooth edges
    height, width = picture.shape[:2]
    mask = Image.new("L", (width * scale, height * scale))
    draw = ImageDraw.Draw(mask)
    radius = scale * max(0.9, height / 400)
    for x, y in scale * projected[:, :2]:
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
    share = np.asarray(mask.resize((width, height), Image.Resampling.BOX), np.float32)[..., None] / 255
    return np.rint(picture * (1 - share) + np.asarray(color, np.float32) * share).astype(np.uint8)
