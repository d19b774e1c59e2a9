"""Measure an avatar on the frames of a split."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from snarfcli.errors import UserError
from snarfcli.evaluation.metrics import FrameMetrics, in_box, iou
from snarfcli.progress import progress

__all__ = ["Field", "FieldValues", "Samples", "choose_frames", "choose_points", "evaluate", "measure_frame", "predict_inside"]

_POINTS_AT_ONCE = 100_000  # points in one query, which bounds the memory of the search; frames have 20,000 by default


class FieldValues(Protocol):
    """What is needed of an answer of the field; see `snarfcli.models.system.FieldSamples`."""

    logits: Tensor
    counts: Tensor
    search_s: float
    shape_s: float


class Field(Protocol):
    """What is needed of an avatar."""

    def query(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> FieldValues: ...


class Samples(Protocol):
    """What is needed of the samples of a sequence; see `snarfcli.samples.store.SequenceSamples`."""

    name: str
    num_frames: int
    num_points: int
    num_uniform: int
    poses: np.ndarray
    translation: np.ndarray
    bone_transforms: np.ndarray
    frame_numbers: np.ndarray

    def points(self, frames: int, index: np.ndarray | None = None) -> np.ndarray: ...

    def occupancies(self, frames: int, index: np.ndarray | None = None) -> np.ndarray: ...

    def box(self, frame: int) -> tuple[np.ndarray, np.ndarray]: ...

    def vertices(self, frame: int) -> np.ndarray: ...

    def faces(self, frame: int) -> np.ndarray: ...


def choose_frames(sequences: Sequence[Samples], max_frames: int | None = None) -> list[tuple[Samples, int]]:
    """Return pairs of a sequence and the index of a frame: all, or `max_frames` evenly spaced over all sequences.

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
    # in the middle of equal stretches, not at their ends, where a motion often begins and ends at rest
    chosen = ((np.arange(max_frames) + 0.5) * len(frames) / max_frames).astype(int)
    return [frames[index] for index in chosen]


def choose_points(num_points: int, num_uniform: int, count: int | None, seed: int) -> np.ndarray | None:
    """Return the sorted numbers of `count` points of a frame, half of them uniform, half near the surface; None for all.

    Args:
        num_points: points of a frame.
        num_uniform: how many of them are uniform; they come first.
        count: number of points, null for all.
        seed: chooses the points; frames are sampled independently, so the same numbers serve all of them.

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
    avatar: Field,
    sequences: Sequence[Samples],
    *,
    max_frames: int | None = None,
    points: int | None = None,
    seed: int = 0,
    desc: str = "eval",
) -> list[FrameMetrics]:
    """Measure the avatar on the frames of all sequences, one after the other.

    Args:
        avatar: the field; a point is predicted to be inside where its logit is above 0.
        sequences: samples.
        max_frames: so many frames, evenly spaced over all sequences.
        points: so many points of each frame.
        seed: of the choice of points.
        desc: what the progress line says.

    Raises:
        UserError: a number is out of range, or there are no frames.
    """
    frames = choose_frames(sequences, max_frames)
    first, _ = frames[0]
    # The first call pays for the allocation of memory and the choice of algorithms, which is no property of the avatar.
    measure_frame(avatar, *frames[0], choose_points(first.num_points, first.num_uniform, points, seed))
    measured = []
    for sequence, index in progress(frames, desc=desc, unit="frames"):
        chosen = choose_points(sequence.num_points, sequence.num_uniform, points, seed)
        measured.append(measure_frame(avatar, sequence, index, chosen))
    return measured


def measure_frame(avatar: Field, sequence: Samples, index: int, chosen: np.ndarray | None = None) -> FrameMetrics:
    """Measure the avatar on one frame.

    Args:
        avatar: the field.
        sequence: samples.
        index: frame.
        chosen: sorted numbers of the points to take, all if None.
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


def predict_inside(avatar: Field, sequence: Samples, index: int, points: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] of one frame the avatar predicts to be inside, bool [N]."""
    transforms, pose = _posed(sequence, index)
    parts = torch.as_tensor(points).split(_POINTS_AT_ONCE)
    return np.concatenate([(avatar.query(part[None], transforms, pose).logits[0] > 0).cpu().numpy() for part in parts])


def _posed(sequence: Samples, index: int) -> tuple[Tensor, Tensor]:
    """Return the bone transforms [1, J, 4, 4] and the pose [1, J, 3] of one frame."""
    return torch.as_tensor(sequence.bone_transforms[index])[None], torch.as_tensor(sequence.poses[index])[None]


def _query(
    avatar: Field, sequence: Samples, index: int, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float, float]:
    """Return which points [N, 3] are inside, bool [N], how many correspondences each has, [N], and the seconds it took."""
    transforms, pose = _posed(sequence, index)
    inside, counts, search_s, shape_s, total_s = [], [], 0.0, 0.0, 0.0
    for part in torch.as_tensor(points).split(_POINTS_AT_ONCE):
        start = time.perf_counter()
        values = avatar.query(part[None], transforms, pose)
        on_gpu = values.logits.is_cuda
        if on_gpu:
            torch.cuda.synchronize(values.logits.device)
        seconds = time.perf_counter() - start
        total_s += seconds
        search_s += values.search_s
        # The search hands over a number of roots, so it is over when its clock stops; what comes after it on a GPU is only
        # queued by then, so the rest of the time is the network's.
        shape_s += max(seconds - values.search_s, 0.0) if on_gpu else values.shape_s
        inside.append((values.logits[0] > 0).cpu().numpy())
        counts.append(values.counts[0].cpu().numpy())
    return np.concatenate(inside), np.concatenate(counts), search_s, shape_s, total_s
