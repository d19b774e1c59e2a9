"""The averaged avatar of a training: its validation, and what is done to it at the end."""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from contextlib import closing

import numpy as np
import torch
from torch import Tensor

from snarfcli.evaluation.metrics import iou
from snarfcli.fitting import PoseRefiner
from snarfcli.models.system import Found
from snarfcli.models.trained_field import TrainedField
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.texts import counted
from snarfcli.training.batches import FrameBatches, load_frames

__all__ = ["averaged", "drop_needless", "validate"]

log = logging.getLogger(__name__)

Frames = list[tuple[SequenceSamples, int]]
"""Frames of sequences."""

_STEPS_OF_SUPPORT = 12  # whose inside points show which pieces of the shape belong to the subject
_POSES_AT_THE_END = 24  # number of training poses from which the searched cells of the finished avatar follow


@torch.no_grad()
def averaged(avatar: TrainedField, average: Sequence[Tensor]) -> TrainedField:
    """Return a copy of an avatar with averaged parameters, ready to use, on the same device."""
    result = avatar.with_model(copy.deepcopy(avatar.model))
    trained = [parameter for parameter in result.model.parameters() if parameter.requires_grad]
    for parameter, value in zip(trained, average, strict=True):
        parameter.copy_(value)
    return result.to(avatar.device)


def drop_needless(avatar: TrainedField, batches: FrameBatches, precision: str) -> None:
    """Shrink the searched cells of an averaged avatar to its shape in training poses, without floating pieces."""
    poses = batches.poses(_POSES_AT_THE_END)
    avatar.model.tighten_cells(poses, precision)
    with closing(batches):
        inside = (_found_inside(avatar, batches, step) for step in range(_STEPS_OF_SUPPORT))
        dropped = avatar.model.drop_pieces(poses, inside)
    if dropped:
        wanted = avatar.config.model.components
        why = "no point inside a training mesh needs it; model.components=N keeps the N largest" if wanted is None else ""
        why = why or f"model.components={wanted}"
        log.info("dropped %s of the shape beside the body (%s)", counted(dropped, "piece"), why)
    avatar.model.freeze()


def _found_inside(avatar: TrainedField, batches: FrameBatches, step: int) -> tuple[Found, Tensor]:
    """Return where the points of a step's batch that are inside the meshes come from, and the poses [B, J, 3] there."""
    batch = batches.batch(step)
    nowhere = batch.cube[:, None, 1] + 10 * (batch.cube[:, None, 1] - batch.cube[:, None, 0])  # beyond all cells
    points = torch.where(batch.occupied[..., None], batch.points, nowhere)
    return avatar.find(points, batch.bone_transforms, batch.pose), batch.pose


def validate(
    avatar: TrainedField, store: SampleStore, most_frames: int, refiner: PoseRefiner | None, most_ood_frames: int = 0
) -> dict[str, float]:
    """Return the IoU of an avatar on held-back frames of the training sequences, uniform and near-surface.

    Args:
        avatar: the averaged one.
        store: processed samples.
        most_frames: number of frames, evenly spaced.
        refiner: refines the poses of these frames first; None leaves them as they are.
        most_ood_frames: number of out-of-distribution frames, evenly spaced, whose IoU is returned too.

    Raises:
        UserError: out-of-distribution frames are wanted, and the store has none.
    """
    frames = [(sequence, int(frame)) for sequence in store.sequences("train") for frame in sequence.val_frames]
    found = _mean_iou(avatar, _evenly(frames, most_frames), refiner)
    if most_ood_frames:
        frames = [(sequence, frame) for sequence in store.sequences("ood") for frame in range(sequence.num_frames)]
        found |= {f"ood_{name}": value for name, value in _mean_iou(avatar, _evenly(frames, most_ood_frames), None).items()}
    return found


def _evenly(frames: Frames, most: int) -> Frames:
    """Return at most `most` of some frames, evenly spaced."""
    count = min(most, len(frames))
    return [frames[index] for index in np.linspace(0, len(frames) - 1, count).round().astype(int)]


@torch.no_grad()
def _mean_iou(avatar: TrainedField, frames: Frames, refiner: PoseRefiner | None) -> dict[str, float]:
    """Return the mean IoU over frames, of every second point; nothing without frames."""
    if refiner is not None:
        refiner.refine_all(avatar, frames, desc="validate: refine poses")
    values = []
    for sequence, frame in frames:
        batch = load_frames([(sequence, frame, np.arange(0, sequence.num_points, 2))], avatar.device)
        inside = avatar.query(batch.points, batch.bone_transforms, batch.pose).logits > 0
        inside, occupied = inside[0].cpu().numpy(), batch.occupied[0].cpu().numpy()
        half = len(inside) // 2
        values.append([iou(inside[:half], occupied[:half]), iou(inside[half:], occupied[half:])])
    if refiner is not None:
        refiner.poses.forget(frames)  # so that a resumed run, which validates again, has the same poses
    if not values:
        return {}
    bbox, surface = np.mean(values, 0)
    return {"iou_bbox": float(bbox), "iou_surface": float(surface)}
