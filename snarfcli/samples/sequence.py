"""The processed samples of one sequence.

Worker processes of training import this file. It does without PyTorch, so they start in a fifth of the time.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.datasets.splits import Split
from snarfcli.errors import UserError
from snarfcli.samples.layout import check_digest, check_sizes, checked_array, open_array, read_arrays, repair_advice
from snarfcli.sampling.cube import dequantise, unpack_vertices
from snarfcli.texts import one_line

__all__ = ["Frame", "SequenceSamples"]

_VALIDATION_SHARE = 0.1


class SequenceSamples:
    """The samples of one sequence: T frames of P points. Points and labels are memory-mapped, not loaded."""

    def __init__(self, folder: Path, description: dict[str, Any]) -> None:
        """Open a sequence.

        Args:
            folder: its folder.
            description: content of its `sequence.json`.

        Raises:
            UserError: a file is missing, has a wrong size or wrong content.
        """
        self.folder = folder
        self.description = description
        self.name: str = description["name"]
        self.split: Split = description["split"]
        self.num_frames: int = description["frames"]
        self.num_points: int = description["points_per_frame"]
        check_sizes(folder, description["files"])
        self._cells = open_array(folder / "points.npy", (self.num_frames, self.num_points, 3), np.uint16)
        self._packed = open_array(folder / "occupancies.npy", (self.num_frames, self.num_points // 8), np.uint8)
        arrays = _frame_arrays(folder / "frames.npz", self.num_frames)
        self._vertex_start, self._face_start = arrays["vertex_start"], arrays["face_start"]
        self._topology = arrays["topology"]
        self.poses: np.ndarray = arrays["poses"]
        """[T, J, 3], float32, axis-angle, radians, global orientation included."""
        self.translation: np.ndarray = arrays["translation"]
        """[T, 3], float32, metres; already part of the bone transforms."""
        self.bone_transforms: np.ndarray = arrays["posed_from_canonical"]
        """[T, J, 4, 4], float32, canonical to posed, metres."""
        self.joints: np.ndarray = arrays["joints"]
        """[T, J, 3], float32, posed joints, metres."""
        self.frame_numbers: np.ndarray = arrays["frame_numbers"]
        """[T], int64, indices of the frames within the motion."""
        self.frame_rate: float = description["frame_rate"]
        """Frames per second of the motion, which may have frames that were not sampled."""
        self._cube_lower, self._cube_size = arrays["cube_lower"], arrays["cube_size"]
        self._box_lower, self._box_upper = arrays["box_lower"], arrays["box_upper"]

    # Opened at first use, since a process may have only a limited number of files open.
    @cached_property
    def _vertices(self) -> np.ndarray:
        return open_array(self.folder / "vertices.npy", (int(self._vertex_start[-1]),), np.uint64)

    @cached_property
    def _faces(self) -> np.ndarray:
        return open_array(self.folder / "faces.npy", (int(self._face_start[-1]), 3), np.int32)

    @property
    def num_uniform(self) -> int:
        """Number of points that are uniform in the cube: the first half of P. The others are near the surface."""
        return self.num_points // 2

    @property
    def train_frames(self) -> np.ndarray:
        """Frames to train on: all but the last tenth of a training sequence; empty for other splits."""
        return np.arange(self.num_frames - self._num_validation if self.split == "train" else 0)

    @property
    def val_frames(self) -> np.ndarray:
        """Frames to validate on: the last tenth of a training sequence; empty for other splits."""
        last = self.num_frames if self.split == "train" else 0
        return np.arange(max(0, last - self._num_validation), last)

    @property
    def _num_validation(self) -> int:
        return min(self.num_frames - 1, max(1, round(self.num_frames * _VALIDATION_SHARE)))

    def points(self, frames: int | np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
        """Return posed points; only the chosen ones are read from disk.

        Args:
            frames: a frame, or [B] frames.
            index: [N] or [B, N], indices of the points, the same in each frame or per frame; None for all points.

        Returns:
            [..., N, 3], float32, metres; the leading dimensions are those of `frames`.
        """
        frames, rows = _rows(frames, index)
        cells = self._cells[frames] if index is None else self._cells[rows, index]
        return dequantise(cells, self._cube_lower[frames][..., None, :], self._cube_size[frames][..., None, None])

    def stored_points(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return all points of frames [B] as they are stored, see `dequantise`.

        Returns:
            The cells [B, P, 3], uint16, and the lower corners [B, 3] and sides [B] of the cubes, float32, metres.
        """
        return self._cells[frames], self._cube_lower[frames], self._cube_size[frames]

    def occupancies(self, frames: int | np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
        """Return the labels [..., N], bool, True inside, of the points that `points` returns."""
        frames, rows = _rows(frames, index)
        if index is None:
            return np.unpackbits(self._packed[frames], axis=-1).view(bool)
        index = np.asarray(index)
        return ((self._packed[rows, index >> 3] >> (7 - (index & 7)).astype(np.uint8)) & 1).view(bool)

    def vertices(self, frame: int) -> np.ndarray:
        """Return the vertices [V, 3] of the posed mesh of one frame, float32, metres, accurate to a micrometre."""
        cells = self._vertices[self._vertex_start[frame] : self._vertex_start[frame + 1]]
        return unpack_vertices(cells, self._cube_lower[frame], self._cube_size[frame])

    def faces(self, frame: int) -> np.ndarray:
        """Return the faces [F, 3] of the mesh of one frame, int32, outward.

        Raises:
            UserError: they name vertices that the mesh does not have.
        """
        topology = self._topology[frame]
        faces = np.array(self._faces[self._face_start[topology] : self._face_start[topology + 1]])
        count = self._vertex_start[frame + 1] - self._vertex_start[frame]
        if faces.size and not 0 <= faces.min() <= faces.max() < count:
            there = f"{self.folder / 'faces.npy'} names other vertices than the {count} of frame {frame}"
            raise UserError(f"the samples are damaged: {there}; {repair_advice(self.folder)}")
        return faces

    def box(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounding box of the posed mesh of one frame: lower [3] and upper [3] corner, float32, metres."""
        return self._box_lower[frame], self._box_upper[frame]

    def cube(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the sampling cube of one frame, as in the papers: lower [3] and upper [3] corner, float32, metres."""
        return self._cube_lower[frame], self._cube_lower[frame] + self._cube_size[frame]

    def verify(self) -> None:
        """Compare every file with its checksum.

        Raises:
            UserError: one differs.
        """
        for name, entry in self.description["files"].items():
            check_digest(self.folder / name, entry["sha256"])


Frame = tuple[SequenceSamples, int]
"""A sequence and the index of one of its frames."""


def _frame_arrays(path: Path, num_frames: int) -> dict[str, np.ndarray]:
    """Return the arrays of `frames.npz`.

    Raises:
        UserError: one is missing, or has another type, shape or values than it is written with.
    """
    arrays = read_arrays(path)
    try:
        joints = checked_array(arrays, "poses", np.float32, (num_frames, None, 3)).shape[1]
        for name, shape in (
            ("translation", (3,)), ("posed_from_canonical", (joints, 4, 4)), ("joints", (joints, 3)),
            ("cube_lower", (3,)), ("cube_size", ()), ("box_lower", (3,)), ("box_upper", (3,)),
        ):  # fmt: skip
            checked_array(arrays, name, np.float32, (num_frames, *shape), least=0.0 if name == "cube_size" else None)
        if (np.diff(checked_array(arrays, "frame_numbers", np.int64, (num_frames,), least=0)) <= 0).any():
            raise ValueError("frame_numbers: wanted rising numbers, got others")
        topology = checked_array(arrays, "topology", np.int64, (num_frames,), least=0)
        _check_starts(arrays, "vertex_start", num_frames)
        _check_starts(arrays, "face_start", 1 + int(topology.max()))
    except (KeyError, ValueError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else one_line(error, 200)
        raise UserError(f"the samples are damaged: {path}: {reason}; {repair_advice(path.parent)}") from None
    return arrays


def _check_starts(arrays: dict[str, np.ndarray], name: str, count: int) -> None:
    """Check the starts of `count` parts that follow each other, and the end of the last.

    Raises:
        KeyError, ValueError: they are not in order.
    """
    starts = checked_array(arrays, name, np.int64, (None,), least=0)
    if len(starts) != count + 1 or starts[0] != 0 or (np.diff(starts) < 0).any():
        raise ValueError(f"{name}: wanted the starts of {count} parts in order, got {len(starts)} numbers")


def _rows(frames: int | np.ndarray, index: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return `frames` as an array, and the same with an axis for points if there is an index."""
    frames = np.asarray(frames)
    return frames, frames[..., None] if index is not None else frames
