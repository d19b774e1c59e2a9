"""Sources of the posed meshes of a sequence: arrays, a body model, a rig, or files.

Worker processes unpickle the result of `chosen` and import this file for it. It does not import PyTorch, whose import takes
longer than sampling ten frames, so that they start in 0.4 s.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from snarfcli.files import file_digest

if TYPE_CHECKING:
    from snarfcli.bodies import Body

__all__ = ["ArrayMeshes", "BodyMeshes", "FileMeshes", "PosedMeshes", "RigMeshes"]

Mesh = tuple[NDArray, NDArray]


class PosedMeshes(Protocol):
    """The posed meshes of one sequence by frame: vertices [V, 3], metres, and outward faces [F, 3].

    The main process calls `chosen` and sends the result to a worker process, which reads the meshes. The result must be
    picklable, and small or fast to compute.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Mesh: ...

    def chosen(self, frames: NDArray[np.int64]) -> PosedMeshes:
        """Return the meshes of some frames."""
        ...

    def source(self, index: int) -> str:
        """Return the name of the file that a mesh is read from; empty if there is none."""
        ...

    def fingerprint(self) -> str:
        """Return a digest of the files that the meshes are read from; empty if there are none."""
        ...


@dataclass(frozen=True, eq=False)
class ArrayMeshes:
    """Meshes of one topology in memory."""

    vertices: NDArray
    """[T, V, 3], metres."""
    faces: NDArray
    """[F, 3], vertex numbers, outward."""

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
    """A body model in the poses of a motion; posed when frames are chosen.

    Args:
        body: the model.
        betas: [S'], shape parameters.
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
        import torch  # here, since worker processes start without it

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
    """A rigged mesh, posed by linear blend skinning when frames are chosen."""

    vertices: NDArray
    """[V, 3], vertices in the rest pose, metres."""
    faces: NDArray
    """[F, 3], vertex numbers, outward."""
    weights: NDArray
    """[V, J], skinning weights, rows sum to 1."""
    posed_from_rest: NDArray
    """[T, J, 4, 4], bone transforms, metres."""

    def __len__(self) -> int:
        return len(self.posed_from_rest)

    def __getitem__(self, index: int) -> Mesh:
        return self.chosen(np.array([index]))[0]

    def chosen(self, frames: NDArray[np.int64]) -> ArrayMeshes:
        from snarfcli.bodies.skinning import skin_vertices  # here, since the room `bodies` imports PyTorch

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
    """T files."""
    read: Callable[[Path], Mesh]
    """A module-level function that reads one file."""
    world_from_file: NDArray
    """[4, 4], rotation and scale from the vertices of a file to metres and y up."""

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> Mesh:
        vertices, faces = self.read(self.paths[index])
        return vertices @ self.world_from_file[:3, :3].T + self.world_from_file[:3, 3], faces

    def chosen(self, frames: NDArray[np.int64]) -> FileMeshes:
        return FileMeshes([self.paths[frame] for frame in frames], self.read, self.world_from_file)

    def source(self, index: int) -> str:
        return str(self.paths[index])

    def fingerprint(self) -> str:
        # Names and contents, not times, so that a copy of a data set counts as equal. Sizes are not enough: a binary mesh keeps
        # its size when vertices change.
        contents = "\n".join(f"{path.name} {file_digest(path)}" for path in self.paths)
        return hashlib.sha256(contents.encode()).hexdigest()[:16]
