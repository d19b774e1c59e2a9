"""Poses that bodies are known to take: starts of the fit, and what is usual."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, builtin_motion
from snarfcli.motions.layouts import SMPL, carry_over
from snarfcli.motions.plain_names import plain_name
from snarfcli.registration.rotations import matrix_to_vector, vector_to_matrix
from snarfcli.registration.solver import PosePrior

__all__ = ["PoseLibrary"]

Array = NDArray[np.float64]

_SEEDS = (1, 2)
_FEW = 100  # poses, fewer of which do not tell what is usual
_FRAME_RATE = 8.0  # per second; consecutive poses are then about as far apart as poses of different seeds


@dataclass(frozen=True, eq=False)
class PoseLibrary:
    """Poses of one skeleton, all facing +z."""

    poses: Array
    """[L, J, 3], axis-angle, radians."""

    @classmethod
    def builtin(cls, joint_names: Sequence[str], leave_out: Collection[str] = ()) -> PoseLibrary:
        """Return the rest pose and the poses of the built-in motions.

        Args:
            joint_names: J joint names; joints that are not among SMPL's stay at rest.
            leave_out: names of motions to leave out.
        """
        names = tuple(plain_name(name) for name in joint_names)
        motions = tuple(name for name in (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES) if name not in leave_out)
        return cls.of_rig(len(names), carry_over(_poses(motions), SMPL, names, "rest") if motions else None)

    @classmethod
    def of_rig(cls, joints: int, poses: Array | None = None) -> PoseLibrary:
        """Return the rest pose and the poses [L, J, 3] of a rig's own clips, axis-angle, radians."""
        rest = np.zeros((1, joints, 3))
        return cls(facing_forwards(rest if poses is None else np.concatenate([rest, poses])))

    def prior(self) -> PosePrior:
        """Return the prior by which poses unlike those of the library cost more; a weak one if the library has few."""
        return PosePrior.of_poses(self.poses) if len(self.poses) >= _FEW else PosePrior.weak(self.poses.shape[1])


@lru_cache(maxsize=4)  # making them takes a second, and a process may fit many subjects
def _poses(motions: tuple[str, ...]) -> Array:
    """Return the poses [L, J, 3] of built-in motions, all seeds."""
    poses = [builtin_motion(name, seed, frame_rate=_FRAME_RATE).poses for name in motions for seed in _SEEDS]
    return np.concatenate(poses)


def facing_forwards(poses: Array) -> Array:
    """Return poses [L, J, 3] whose root is turned about y, so that its z axis has no part along x."""
    roots = vector_to_matrix(poses[:, 0])
    yaw = np.arctan2(roots[:, 0, 2], roots[:, 2, 2])
    back = vector_to_matrix(np.stack([np.zeros_like(yaw), -yaw, np.zeros_like(yaw)], 1))
    turned = poses.copy()
    turned[:, 0] = matrix_to_vector(back @ roots)
    return turned
