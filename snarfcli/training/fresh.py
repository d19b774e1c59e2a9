"""Points that are drawn and labelled anew in every step, from the posed meshes in the store.

Worker processes import this file, so it must not import PyTorch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from snarfcli.samples.sequence import SequenceSamples
from snarfcli.sampling import in_turned_over, occupancies, outline_samples, uniform_surface_samples

__all__ = ["DrawnPoints", "FreshPoints", "draw_steps"]


@dataclass
class DrawnPoints:
    """Labelled points of one step: B frames of N points."""

    frames: list[tuple[int, int]]
    """Index of the sequence, and of the frame in it, for each of the B frames."""
    points: np.ndarray
    """[B, N, 3] float32, posed frame, metres: first the uniform ones, then those near the surface."""
    occupied: np.ndarray
    """[B, N] bool."""


class FreshPoints:
    """Random frames and points around their meshes; step k has the same points in every process.

    Args:
        sequences: training sequences.
        settings: with which the samples were made. The points have the same distribution, except that before the noise those
            near the surface are uniform on it: Poisson disks take too long for every step.
        frames_per_step: number of frames B per step.
        uniform: number of points per frame that are uniform in its cube.
        surface: number of points per frame that are near its surface.
        seed: of the run.
    """

    def __init__(
        self,
        sequences: Sequence[SequenceSamples],
        settings: dict[str, Any],
        frames_per_step: int,
        uniform: int,
        surface: int,
        seed: int,
    ) -> None:
        self.sequences, self.settings, self.seed = sequences, settings, seed
        self.frames_per_step, self.uniform, self.surface = frames_per_step, uniform, surface
        self.frames = [(index, int(frame)) for index, s in enumerate(sequences) for frame in s.train_frames]

    def __reduce__(self) -> tuple[Any, ...]:
        # Memory maps would be pickled as copies, so the other process opens the files again.
        places = [(sequence.folder.absolute(), sequence.description) for sequence in self.sequences]
        return _reopen, (places, self.settings, self.frames_per_step, self.uniform, self.surface, self.seed)

    def draw(self, step: int) -> DrawnPoints:
        """Return the points of one step.

        Raises:
            UserError: a mesh has no area.
        """
        random = np.random.default_rng([self.seed, step, 3])
        count = self.frames_per_step
        chosen = random.choice(len(self.frames), count, replace=count > len(self.frames))
        frames = [self.frames[index] for index in chosen]
        drawn = [self._draw_frame(self.sequences[sequence], frame, random) for sequence, frame in frames]
        return DrawnPoints(frames, np.stack([points for points, _ in drawn]), np.stack([inside for _, inside in drawn]))

    def _draw_frame(self, sequence: SequenceSamples, frame: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return points [N, 3] of one frame, and which of them are inside, [N]."""
        vertices, faces = sequence.vertices(frame), sequence.faces(frame)
        lower, upper = sequence.cube(frame)
        uniform = lower + random.random((self.uniform, 3)) * (upper - lower)
        is_planar = self.settings.get("is_planar", False)  # only samples of planar subjects have it
        near = (outline_samples if is_planar else uniform_surface_samples)(vertices, faces, self.surface, random)
        near += random.normal(scale=self.settings["surface_noise_m"], size=near.shape)
        points = np.clip(np.concatenate([uniform, near]), lower, upper).astype(np.float32)  # like the stored points
        if is_planar:
            points[:, 2] = 0.0
        inside = occupancies(vertices, faces, points, self.settings["inside_test"])
        if is_planar and self.settings["inside_test"] == "winding":
            inside |= in_turned_over(vertices, faces, points)
        return points, inside


def draw_steps(points: FreshPoints, first: int, stride: int) -> Iterator[DrawnPoints]:
    """Yield the points of steps `first`, `first + stride`, `first + 2 stride` and so on without end."""
    step = first
    while True:
        yield points.draw(step)
        step += stride


def _reopen(places: list[tuple[Any, dict[str, Any]]], *arguments: Any) -> FreshPoints:
    """Return the points of sequences given by folder and description; see `FreshPoints.__reduce__`."""
    return FreshPoints([SequenceSamples(folder, description) for folder, description in places], *arguments)
