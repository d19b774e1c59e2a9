"""What BVH and glTF files have in common: a tree of joints, clips of motion, and a mesh that the joints move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Rig", "RigClip", "RigMesh"]


@dataclass(frozen=True, eq=False)
class RigClip:
    """One motion of a rig, sampled at equal times."""

    name: str
    """Its name in the file, made up if it has none."""
    frame_rate: float
    """Frames a second."""
    world_from_joint: NDArray[np.float64]
    """[T, J, 4, 4] where each joint is: from its own frame to the world, in the units of the file. May hold scale."""


@dataclass(frozen=True, eq=False)
class RigMesh:
    """A triangle mesh in the rest pose, with the weights by which it follows the joints."""

    vertices: NDArray[np.float64]
    """[V, 3] in the world, units of the file, moved by `world_from_joint @ inv(rest)`, blended by the weights."""
    faces: NDArray[np.int64]
    """[F, 3] triangles."""
    weights: NDArray[np.float64]
    """[V, J] non-negative, rows sum to 1."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A tree of joints at rest, its motions and its mesh."""

    names: tuple[str, ...]
    """J joint names, each once."""
    parents: tuple[int, ...]
    """J parents, -1 for a root; a parent comes before its children, joint 0 is a root."""
    rest: NDArray[np.float64]
    """[J, 4, 4] where each joint is at rest: from its own frame to the world, units of the file."""
    clips: tuple[RigClip, ...]
    """The motions, none or more."""
    mesh: RigMesh | None = None
    """The mesh, if the file has one."""
