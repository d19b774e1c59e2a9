"""Sources of the posed meshes of a sequence: arrays, a body model, a rig, or files.

Worker processes unpickle the result of `chosen`, for which they import this module. The module does not import PyTorch at the
top, because that takes longer than sampling ten frames. Without it, a worker process starts in 0.4 s.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from snarfcli.files import file_digest

if TYPE_CHECKING:
    from snarfcli.bodies import Body

__all__ = ["ArrayMeshes", "BodyMeshes", "FileMeshes", "PosedMeshes", "RigMeshes"]

Mesh = tuple[NDArray, NDArray]
"""Vertices [V, 3], metres, and faces [F, 3], vertex indices, with outward normals."""


class PosedMeshes(Protocol):
    """The posed meshes of one sequence, indexed by frame.

    The main process calls `chosen` and sends the result to a worker process, which reads the meshes from it. So the result must
    be picklable and fast to compute.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Mesh: ...

    def chosen(self, frames: NDArray[np.int64]) -> PosedMeshes:
        """Return the meshes of the frames with these indices [K], in this order."""
        ...

    def source(self, index: int) -> str:
        """Return the name of the file that a mesh is read from; empty if there is none."""
        ...

    def fingerprint(self) -> str:
        """Return a digest of the files that the meshes are read from; empty if there are none."""
        ...


@dataclass(frozen=True, eq=False)
class ArrayMeshes:
    """Meshes in memory that all have the same faces."""

    vertices: NDArray
    """[T, V, 3], metres."""
    faces: NDArray
    """[F, 3], vertex indices, with outward normals."""

    def __len__(self) -> int:
        return len(self.vertices)

    def __getitem__(self, index: int) -> Mesh:
        return self.vertices[index], self.faces

    def chosen(self, frames: NDArray[np.int64]) -> ArrayMeshes:
        return ArrayMeshes(self.vertices[frames], self.faces)

    def source(self, index: int) -> str:
        return ""

    def fingerprint(self) -> str:
        return ""


class BodyMeshes:
    """A body model in the poses of a motion. `chosen` computes the meshes.

    Args:
        body: the model.
        betas: [S], shape parameters.
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
    """

    def __init__(self, body: Body, betas: NDArray, poses: NDArray, translation: NDArray) -> None:
        self.body, self.betas, self.poses, self.translation = body, betas, poses, translation

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int) -> Mesh:
        return self.chosen(np.array([index]))[0]

    def chosen(self, frames: NDArray[np.int64]) -> ArrayMeshes:
        import torch  # not at the top, since worker processes do not need it

        body = self.body.to(torch.float64)
        pose, translation = torch.from_numpy(self.poses[frames]), torch.from_numpy(self.translation[frames])
        posed = [  # one at a time, since the pose correctives of all frames are large
            body.pose(pose[i : i + 1], self.betas, translation[i : i + 1]).vertices[0] for i in range(len(frames))
        ]
        return ArrayMeshes(torch.stack(posed).numpy().astype(np.float32), body.faces.numpy().astype(np.int32))

    def source(self, index: int) -> str:
        return ""

    def fingerprint(self) -> str:
        return ""


@dataclass(frozen=True, eq=False)
class RigMeshes:
    """A rigged mesh. `chosen` poses it by linear blend skinning."""

    vertices: NDArray
    """[V, 3], vertices in the rest pose, metres."""
    faces: NDArray
    """[F, 3], vertex indices, with outward normals."""
    weights: NDArray
    """[V, J], skinning weights; each row sums to 1."""
    posed_from_rest: NDArray
    """[T, J, 4, 4], bone transforms, metres."""

    def __len__(self) -> int:
        return len(self.posed_from_rest)

    def __getitem__(self, index: int) -> Mesh:
        return self.chosen(np.array([index]))[0]

    def chosen(self, frames: NDArray[np.int64]) -> ArrayMeshes:
        from snarfcli.bodies.skinning import skin_vertices  # not at the top: the package `bodies` imports PyTorch

        posed = skin_vertices(self.vertices, self.weights, self.posed_from_rest[frames])
        return ArrayMeshes(posed.astype(np.float32), self.faces.astype(np.int32))

    def source(self, index: int) -> str:
        return ""

    def fingerprint(self) -> str:
        return ""


@dataclass(frozen=True, eq=False)
class FileMeshes:
    """One mesh file per frame, read when a mesh is requested."""

    paths: Sequence[Path]
    """[T], one file per frame."""
    read: Callable[..., Mesh]
    """A module-level function that reads a file; it is given the path and, if there are any, the joints."""
    world_from_file: NDArray
    """[4, 4], transform from the units and axes of the files to metres and y up."""
    joints: NDArray | None = None
    """[T, J, 3], joints in each frame, units and axes of the files."""

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> Mesh:
        vertices, faces = self.read(self.paths[index], *([] if self.joints is None else [self.joints[index]]))
        return vertices @ self.world_from_file[:3, :3].T + self.world_from_file[:3, 3], faces

    def chosen(self, frames: NDArray[np.int64]) -> FileMeshes:
        joints = None if self.joints is None else self.joints[frames]
        return replace(self, paths=[self.paths[frame] for frame in frames], joints=joints)

    def source(self, index: int) -> str:
        return str(self.paths[index])

    def fingerprint(self) -> str:
        # From names and contents, not modification times, so that a copy of a data set has the same fingerprint. Sizes would
        # not be enough: the size of a binary mesh file stays the same when vertices change.
        contents = "\n".join(f"{path.name} {file_digest(path)}" for path in self.paths)
        return hashlib.sha256(contents.encode()).hexdigest()[:16]
