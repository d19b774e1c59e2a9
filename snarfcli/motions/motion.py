"""A sequence of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from snarfcli.field_docs import documented

__all__ = ["Motion"]


@documented
@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of one skeleton over time, in a world with y up."""

    name: str
    """Name of the sequence in tables and file names."""
    poses: NDArray[np.float64]
    """[T, J, 3], axis-angle of each joint relative to its parent, radians; joint 0 is the global orientation."""
    translation: NDArray[np.float64]
    """[T, 3], offset of the root joint from its rest position, metres."""
    frame_rate: float
    """Frames per second."""

    def __post_init__(self) -> None:
        if self.poses.ndim != 3 or self.poses.shape[2] != 3 or len(self.poses) == 0:
            raise ValueError(f"poses: wanted shape [T, J, 3] with T > 0, got {list(self.poses.shape)}")
        if self.translation.shape != (len(self.poses), 3):
            raise ValueError(f"translation: wanted shape [{len(self.poses)}, 3], got {list(self.translation.shape)}")
        if not self.frame_rate > 0:
            raise ValueError(f"frame_rate: wanted a positive number, got {self.frame_rate}")

    @property
    def num_frames(self) -> int:
        """T, the number of frames."""
        return len(self.poses)

    def slice(self, start: int | None = None, stop: int | None = None, step: int = 1) -> Motion:
        """Return the frames `start:stop:step`; open ends and negative numbers as in Python.

        Raises:
            ValueError: step is not positive, or no frame is left.
        """
        if step < 1:
            raise ValueError(f"step: wanted a positive number, got {step}")
        frames = slice(start, stop, step)
        if not len(self.poses[frames]):
            raise ValueError(f"no frame of {self.name} is in {start}:{stop}; it has {self.num_frames} frames")
        return replace(self, poses=self.poses[frames], translation=self.translation[frames], frame_rate=self.frame_rate / step)

    def resampled(self, frame_rate: float) -> Motion:
        """Return the motion at another frame rate: rotations by slerp, translation linearly, same start and speed."""
        if not frame_rate > 0:
            raise ValueError(f"frame_rate: wanted a positive number, got {frame_rate}")
        if self.num_frames == 1:
            return replace(self, frame_rate=frame_rate)
        old = np.arange(self.num_frames) / self.frame_rate
        new = np.arange(int(np.floor(old[-1] * frame_rate + 1e-6)) + 1) / frame_rate
        new = np.minimum(new, old[-1])
        joints = range(self.poses.shape[1])
        poses = [Slerp(old, Rotation.from_rotvec(self.poses[:, j]))(new).as_rotvec() for j in joints]
        translation = [np.interp(new, old, self.translation[:, axis]) for axis in range(3)]
        return replace(self, poses=np.stack(poses, 1), translation=np.stack(translation, 1), frame_rate=frame_rate)
