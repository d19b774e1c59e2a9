"""All samples of a subject on the device, and batches that are drawn there."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from snarfcli.draws import HashedDraws
from snarfcli.samples.store import SampleStore
from snarfcli.sampling.cube import CUBE_LEVELS
from snarfcli.training.batches import Batch, FrameBatches
from snarfcli.training.settings import TrainingConfig

__all__ = ["DeviceBatches"]

_FRAMES, _UNIFORM, _SURFACE = 7, 8, 9  # purposes of random numbers; others are in objective.py and trainer.py
_FRAME_BITS = 20  # of the number of a frame in its sorting key


class DeviceBatches(FrameBatches):
    """Batches of random frames and stored points, drawn on the device from seed and step.

    The distribution is that of `FrameBatches`; the numbers are others. A batch needs nothing from the host if its step is a
    tensor. The samples take 7 bytes per point: 60 MB for 430 frames of 20,000 points.

    Arguments: as `FrameBatches`.

    Raises:
        torch.OutOfMemoryError: the device has no room for the samples.
    """

    are_static: ClassVar[bool] = True

    def __init__(self, store: SampleStore, config: TrainingConfig, seed: int, device: torch.device) -> None:
        super().__init__(store, config, seed, device)
        chosen = [(s, s.train_frames) for s in self.sequences if len(s.train_frames)]
        counts = np.concatenate([np.full(len(frames), s.num_points) for s, frames in chosen])
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        stored = [s.stored_points(frames) for s, frames in chosen]
        self._cells = torch.cat([self._on_device(cells.reshape(-1, 3).view(np.int16)) for cells, _, _ in stored])
        self._lower = self._on_device(np.concatenate([lower for _, lower, _ in stored]))
        self._step = self._on_device(np.concatenate([size for _, _, size in stored]) / np.float32(CUBE_LEVELS))
        self._occupied = torch.cat([self._on_device(s.occupancies(frames).reshape(-1)) for s, frames in chosen])
        self._cubes = self._on_device(np.stack([np.stack(s.cube(f)) for s, frames in chosen for f in frames]))
        self._transforms = self._on_device(np.concatenate([s.bone_transforms[frames] for s, frames in chosen]))
        self._poses = self._on_device(np.concatenate([s.poses[frames] for s, frames in chosen]))
        self._starts, self._halves = self._on_device(starts), self._on_device(counts // 2)
        self._seconds = self._on_device(counts - counts // 2)

    def _on_device(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    def batch(self, step: int | Tensor) -> Batch:
        """Return the batch of one step, a number or a tensor [], int64, on the device; `frames` is empty."""
        if not isinstance(step, Tensor):
            step = torch.tensor(step, device=self.device)
        chosen = self._chosen_frames(step)
        points, config = self._chosen_points(step, chosen), self.config
        flat = points.flatten()
        cells = (self._cells.index_select(0, flat).int() & (CUBE_LEVELS - 1)).float().view(*points.shape, 3)
        width, lower = self._step.index_select(0, chosen), self._lower.index_select(0, chosen)
        return Batch(
            (cells + 0.5) * width[:, None, None] + lower[:, None],  # as `dequantise`, bit for bit
            self._occupied.index_select(0, flat).view(config.poses_per_step, -1),
            self._transforms.index_select(0, chosen),
            self._poses.index_select(0, chosen),
            [],
            self._cubes.index_select(0, chosen),
        )

    def _chosen_frames(self, step: Tensor) -> Tensor:
        """Return the numbers of the frames of a step, [B]; all are different unless there are fewer than B, or 2^20 or more."""
        draws, count, frames = HashedDraws(self.seed, step, _FRAMES), self.config.poses_per_step, len(self.frames)
        if count > frames or frames >= 2**_FRAME_BITS:
            return draws.integers(frames, count)
        keys = (draws.bits(frames) << _FRAME_BITS) | torch.arange(frames, device=self.device)  # different, so sorted one way
        return keys.topk(count, largest=False).indices

    def _chosen_points(self, step: Tensor, frames: Tensor) -> Tensor:
        """Return the numbers of points of given frames [B], [B, N], among the points of all frames."""
        config, count = self.config, self.config.poses_per_step
        start, half = self._starts.index_select(0, frames)[:, None], self._halves.index_select(0, frames)[:, None]
        second = self._seconds.index_select(0, frames)[:, None]
        uniform = HashedDraws(self.seed, step, _UNIFORM).integers(half, count, config.uniform_points)
        surface = HashedDraws(self.seed, step, _SURFACE).integers(second, count, config.surface_points)
        return torch.cat([start + uniform, start + half + surface], 1)
