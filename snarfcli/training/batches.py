"""Batches of posed points for training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from snarfcli.errors import UserError
from snarfcli.parallel import count_cores
from snarfcli.samples.sequence import Frame, SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.training.fresh import DrawnPoints, FreshPoints, draw_steps
from snarfcli.training.prefetch import Prefetch
from snarfcli.training.settings import TrainingConfig

__all__ = ["Batch", "FrameBatches", "FreshBatches", "load_frames", "new_batches"]

_MOST_WORKERS = 8  # maximum with workers=null; a batch of the largest preset takes one process 0.13 s


@dataclass
class Batch:
    """Sampled points of B frames."""

    points: Tensor
    """[B, N, 3], posed frame, metres."""
    occupied: Tensor
    """[B, N] bool."""
    bone_transforms: Tensor
    """[B, J, 4, 4], canonical to posed, metres."""
    pose: Tensor
    """[B, J, 3] axis-angle, radians."""
    frames: list[Frame]
    """B pairs of a sequence and the index of a frame; empty if they were drawn on the device."""
    cube: Tensor
    """[B, 2, 3], lower and upper corner of the cube that holds the points of a frame, metres; outside, nothing is occupied."""


class FrameBatches:
    """Batches of random frames and stored points; step k has the same batch in every run with the same seed.

    Args:
        store: processed samples of one subject.
        config: gives the numbers of frames and points.
        seed: of the run.
        device: of the batches.
    """

    are_static: ClassVar[bool] = False
    """Whether static steps can read them: `batch` also takes a tensor, after `stage`."""

    def __init__(self, store: SampleStore, config: TrainingConfig, seed: int, device: torch.device) -> None:
        self.sequences = store.sequences("train")
        self.frames = [(index, int(frame)) for index, s in enumerate(self.sequences) for frame in s.train_frames]
        if not self.frames:
            raise UserError('the samples have no training frames; run "snarf preprocess" with the training sequences')
        self.config, self.seed, self.device = config, seed, device

    def batch(self, step: int | Tensor) -> Batch:
        """Return the batch of one step, given as a number, or as a tensor [], int64, if `are_static`."""
        random = np.random.default_rng([self.seed, int(step)])
        count = self.config.poses_per_step
        chosen = random.choice(len(self.frames), count, replace=count > len(self.frames))
        picks = []
        for index in chosen:
            sequence = self.sequences[self.frames[index][0]]
            half = sequence.num_points // 2
            uniform = random.integers(0, half, self.config.uniform_points)
            surface = random.integers(half, sequence.num_points, self.config.surface_points)
            picks.append((sequence, self.frames[index][1], np.concatenate([uniform, surface])))
        return load_frames(picks, self.device)

    def stage(self, step: int) -> None:
        """Prepare the batch of a static step that is started next."""

    def with_poses(self, batch: Batch) -> Batch:
        """Return a batch with the present poses of its frames, which may have been refined."""
        transforms, pose = (torch.as_tensor(v, dtype=torch.float32, device=self.device) for v in _poses_of(batch.frames))
        return replace(batch, bone_transforms=transforms, pose=pose)

    def poses(self, count: int | None = None, random: np.random.Generator | None = None) -> Tensor:
        """Return the poses [P, J, 3] of at most `count` training frames: random ones, or evenly spaced without `random`."""
        count = len(self.frames) if count is None else min(count, len(self.frames))
        if random is None:
            chosen = np.linspace(0, len(self.frames) - 1, count).round().astype(int)
        else:
            chosen = random.choice(len(self.frames), count, replace=False)
        poses = [self.sequences[self.frames[index][0]].poses[self.frames[index][1]] for index in chosen]
        return torch.as_tensor(np.stack(poses), dtype=torch.float32, device=self.device)

    def close(self) -> None:
        """End the processes that make batches ahead of time; the next batch starts them again."""


class FreshBatches(FrameBatches):
    """Batches of random frames and new points; step k has the same batch in every run with the same seed.

    The points are drawn and labelled here if `config.workers` is 0, otherwise ahead of time by that number of processes, or by
    one fewer than the number of cores if it is None.
    """

    def __init__(self, store: SampleStore, config: TrainingConfig, seed: int, device: torch.device) -> None:
        super().__init__(store, config, seed, device)
        self._fresh = FreshPoints(
            self.sequences,
            store.manifest["settings"],
            config.poses_per_step,
            config.uniform_points,
            config.surface_points,
            seed,
        )
        workers = config.workers if config.workers is not None else min(_MOST_WORKERS, max(1, count_cores() - 1))
        self._ahead = Prefetch(draw_steps, (self._fresh,), workers, "training.workers=1") if workers else None

    def batch(self, step: int | Tensor) -> Batch:
        """Return the batch of one step; waits until it is ready.

        Raises:
            UserError: a mesh cannot be used, or a process ended early. All processes have ended then.
        """
        return self.drawn(int(step), self.device)

    def drawn(self, step: int, device: torch.device | str = "cpu") -> Batch:
        """Return the batch of one step on another device; as `batch`."""
        drawn: DrawnPoints = self._ahead.get(step) if self._ahead else self._fresh.draw(step)
        picks = [(self.sequences[sequence], frame) for sequence, frame in drawn.frames]
        return _gather(picks, drawn.points, drawn.occupied, torch.device(device))

    def close(self) -> None:
        if self._ahead:
            self._ahead.close()


def new_batches(store: SampleStore, config: TrainingConfig, seed: int, device: torch.device) -> FrameBatches:
    """Return the batches of the kind that `config` chooses; for the arguments see `FrameBatches`."""
    return (FreshBatches if config.fresh_points else FrameBatches)(store, config, seed, device)


def load_frames(picks: list[tuple[SequenceSamples, int, np.ndarray]], device: torch.device) -> Batch:
    """Return one batch of frames, given as tuples (sequence, frame, point indices)."""
    points = np.stack([sequence.points(frame, index) for sequence, frame, index in picks])
    occupied = np.stack([sequence.occupancies(frame, index) for sequence, frame, index in picks])
    return _gather([(sequence, frame) for sequence, frame, _ in picks], points, occupied, device)


def _gather(frames: list[Frame], points: np.ndarray, occupied: np.ndarray, device: torch.device) -> Batch:
    """Return one batch of points [B, N, 3] and labels [B, N] with the poses of their frames, tuples (sequence, frame)."""
    transforms, pose = _poses_of(frames)
    cube = np.stack([sequence.cube(frame) for sequence, frame in frames])
    return Batch(
        torch.as_tensor(points, dtype=torch.float32, device=device),
        torch.as_tensor(occupied, dtype=torch.bool, device=device),
        torch.as_tensor(transforms, dtype=torch.float32, device=device),
        torch.as_tensor(pose, dtype=torch.float32, device=device),
        list(frames),
        torch.as_tensor(cube, dtype=torch.float32, device=device),
    )


def _poses_of(frames: list[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """Return the bone transforms [B, J, 4, 4] and the poses [B, J, 3] of frames."""
    transforms = np.stack([sequence.bone_transforms[frame] for sequence, frame in frames])
    return transforms, np.stack([sequence.poses[frame] for sequence, frame in frames])
