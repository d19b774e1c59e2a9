"""The common content of BVH and glTF files: a tree of joints, motion clips, and a skinned mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Rig", "RigClip", "RigMesh"]


@dataclass(frozen=True, eq=False)
class RigClip:
    """One motion of a rig, sampled at equal time steps."""

    name: str
    """Name in the file; generated if the file has none."""
    frame_rate: float
    """Frames per second."""
    world_from_joint: NDArray[np.float64]
    """[T, J, 4, 4], transforms from the frame of each joint to the world, units of the file; may contain scale."""


@dataclass(frozen=True, eq=False)
class RigMesh:
    """A triangle mesh in the rest pose, with skinning weights.

    Linear blend skinning poses it: each vertex moves by `world_from_joint @ inv(rest)` of the joints, blended by its weights.
    """

    vertices: NDArray[np.float64]
    """[V, 3], world frame, units of the file."""
    faces: NDArray[np.int64]
    """[F, 3], triangles."""
    weights: NDArray[np.float64]
    """[V, J], non-negative, rows sum to 1."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A tree of joints at rest, with its motions and its mesh."""

    names: tuple[str, ...]
    """J unique joint names."""
    parents: tuple[int, ...]
    """J parents, -1 for a root; a parent comes before its children, joint 0 is a root."""
    rest: NDArray[np.float64]
    """[J, 4, 4], transforms from the frame of each joint at rest to the world, units of the file."""
    clips: tuple[RigClip, ...]
    """The motions; may be empty."""
    mesh: RigMesh | None = None
    """The mesh, if the file has one."""
    humanoid: Mapping[str, int] = field(default_factory=dict)
    """Joint of each bone of a human body that the file names as VRM 1.0 does, such as `leftUpperLeg`; empty for most files."""
    left_out: tuple[tuple[str, str], ...] = ()
    """Name of each motion of the file that cannot be used, and the reason."""
