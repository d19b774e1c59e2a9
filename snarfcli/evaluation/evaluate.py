"""Measure an avatar on the frames of a split."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snarfcli.errors import UserError
from snarfcli.evaluation.metrics import FrameMetrics, in_box, iou
from snarfcli.models.system import FieldSamples
from snarfcli.models.trained_field import TrainedField
from snarfcli.progress import progress
from snarfcli.samples.sequence import SequenceSamples

__all__ = ["choose_frames", "choose_points", "evaluate", "measure_frame", "predict_inside"]

_POINTS_AT_ONCE = 100_000  # points in one query, bounds the memory of the search; a frame has 20,000 by default


def choose_frames(sequences: Sequence[SequenceSamples], max_frames: int | None = None) -> list[tuple[SequenceSamples, int]]:
    """Return pairs of a sequence and a frame index: all frames, or `max_frames` of them, evenly spaced over all sequences.

    Raises:
        UserError: `max_frames` is not positive, or the sequences have no frames.
    """
    if max_frames is not None and max_frames < 1:
        raise UserError(f"max_frames: wanted at least 1, or null for all, got {max_frames}")
    frames = [(sequence, index) for sequence in sequences for index in range(sequence.num_frames)]
    if not frames:
        raise UserError('there are no frames to evaluate; run "snarf preprocess" again with overwrite=true')
    if max_frames is None or max_frames >= len(frames):
        return frames
    # The middles of equal stretches, not their ends: a motion often begins and ends at rest.
    chosen = ((np.arange(max_frames) + 0.5) * len(frames) / max_frames).astype(int)
    return [frames[index] for index in chosen]


def choose_points(num_points: int, num_uniform: int, count: int | None, seed: int) -> np.ndarray | None:
    """Return the sorted indices of `count` points of a frame, half of them uniform, half near the surface; None for all.

    Args:
        num_points: number of points per frame.
        num_uniform: number of uniform points, which come first.
        count: number of points to choose; None for all.
        seed: of the choice. All frames use the same indices, since their points are independent.

    Raises:
        UserError: `count` is less than 2.
    """
    if count is not None and count < 2:
        raise UserError(f"points: wanted at least 2, or null for all, got {count}")
    if count is None or count >= num_points:
        return None
    generator = np.random.default_rng(seed)
    uniform = generator.permutation(num_uniform)[: count // 2]
    surface = num_uniform + generator.permutation(num_points - num_uniform)[: count - count // 2]
    return np.sort(np.concatenate([uniform, surface]))


def evaluate(
    avatar: TrainedField,
    sequences: Sequence[SequenceSamples],
    *,
    max_frames: int | None = None,
    points: int | None = None,
    seed: int = 0,
    desc: str = "eval",
) -> list[FrameMetrics]:
    """Measure the avatar on the frames of all sequences.

    Args:
        avatar: predicts that a point is inside where its logit is above 0.
        sequences: samples.
        max_frames: maximum number of frames, evenly spaced over all sequences; None for all.
        points: maximum number of points per frame; None for all.
        seed: of the choice of points.
        desc: label of the progress line.

    Raises:
        UserError: a number is out of range, there are no frames, or a value is NaN.
    """
    frames = choose_frames(sequences, max_frames)
    first, _ = frames[0]
    # The first call also allocates memory and chooses algorithms, so its times are not used.
    measure_frame(avatar, *frames[0], choose_points(first.num_points, first.num_uniform, points, seed))
    measured = []
    for sequence, index in progress(frames, desc=desc, unit="frames"):
        chosen = choose_points(sequence.num_points, sequence.num_uniform, points, seed)
        measured.append(measure_frame(avatar, sequence, index, chosen))
    return measured


def measure_frame(
    avatar: TrainedField, sequence: SequenceSamples, index: int, chosen: np.ndarray | None = None
) -> FrameMetrics:
    """Measure the avatar on one frame.

    Args:
        avatar: see `evaluate`.
        sequence: samples.
        index: frame index.
        chosen: sorted indices of the points to use; None for all.
    """
    points, occupied = sequence.points(index, chosen), sequence.occupancies(index, chosen)
    uniform = sequence.num_uniform if chosen is None else int(np.searchsorted(chosen, sequence.num_uniform))
    inside, counts, search_s, shape_s, total_s = _query(avatar, sequence, index, points)
    in_tight_box = in_box(points[:uniform], *sequence.box(index))
    return FrameMetrics(
        sequence=sequence.name,
        index=index,
        frame=int(sequence.frame_numbers[index]),
        iou_bbox=float(iou(inside[:uniform], occupied[:uniform])),
        iou_surface=float(iou(inside[uniform:], occupied[uniform:])),
        iou_tight_box=float(iou(inside[:uniform], occupied[:uniform], in_tight_box)),
        points=len(points),
        correspondences=int(counts.sum()),
        several=int((counts > 1).sum()),
        without=int((counts == 0).sum()),
        inside=int(occupied.sum()),
        inside_without=int((occupied & (counts == 0)).sum()),
        search_s=search_s,
        shape_s=shape_s,
        total_s=total_s,
    )


def predict_inside(avatar: TrainedField, sequence: SequenceSamples, index: int, points: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] of one frame the avatar predicts to be inside, bool [N]."""
    transforms, pose = _posed(sequence, index)
    parts = torch.as_tensor(points).split(_POINTS_AT_ONCE)
    values = (avatar.query(part[None], transforms, pose) for part in parts)
    return np.concatenate([_occupied(some, sequence, index).cpu().numpy() for some in values])


def _occupied(values: FieldSamples, sequence: SequenceSamples, index: int) -> Tensor:
    """Return which points [N] of one frame are inside.

    Raises:
        UserError: a value is NaN, which is neither inside nor outside.
    """
    logits = values.logits[0]
    if bool(logits.isnan().any()):
        raise UserError(
            f"{sequence.name}, frame {sequence.frame_numbers[index]}: the avatar's occupancy is NaN at "
            f"{int(logits.isnan().sum())} of {len(logits)} points; train it again, or get it again"
        )
    return logits > 0


def _posed(sequence: SequenceSamples, index: int) -> tuple[Tensor, Tensor]:
    """Return the bone transforms [1, J, 4, 4] and the pose [1, J, 3] of one frame."""
    return torch.as_tensor(sequence.bone_transforms[index])[None], torch.as_tensor(sequence.poses[index])[None]


def _query(
    avatar: TrainedField, sequence: SequenceSamples, index: int, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float, float]:
    """Return which points [N, 3] are inside, bool [N], how many correspondences each has, [N], and the seconds it took."""
    transforms, pose = _posed(sequence, index)
    inside, counts, search_s, shape_s, total_s = [], [], 0.0, 0.0, 0.0
    for part in torch.as_tensor(points).split(_POINTS_AT_ONCE):
        start = _time_s(avatar.device)
        found = avatar.find(part[None], transforms, pose)
        searched = _time_s(avatar.device)
        values = avatar.shape_at(found, pose)
        evaluated = _time_s(avatar.device)
        inside.append(_occupied(values, sequence, index).cpu().numpy())
        counts.append(values.counts[0].cpu().numpy())
        search_s += searched - start
        shape_s += evaluated - searched
        total_s += evaluated - start
    return np.concatenate(inside), np.concatenate(counts), search_s, shape_s, total_s


def _time_s(device: torch.device) -> float:
    """Return the time in seconds when all work so far is done: a GPU only queues it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
