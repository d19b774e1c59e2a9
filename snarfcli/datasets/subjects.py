"""The data of one subject: its skeleton and its sequences of posed meshes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Body, MeshTemplate, Skeleton
from snarfcli.datasets.posed_meshes import BodyMeshes, PosedMeshes
from snarfcli.datasets.splits import Split
from snarfcli.motions import Motion

__all__ = ["SequenceSpec", "SubjectData", "body_sequence", "body_template"]


@dataclass(frozen=True, eq=False)
class SequenceSpec:
    """One sequence of a subject and its split."""

    name: str
    """Name of the sequence, also used as a folder name."""
    split: Split
    """`train` (its last part is for validation), `test` (held out), or `ood` (out of distribution)."""
    motion: Motion
    """Poses, translation and frame rate of the recording."""
    meshes: PosedMeshes
    """The posed mesh of every frame of the motion."""
    posed_from_rest: NDArray[np.float64] | None = None
    """[T, J, 4, 4], bone transforms, metres; None if they follow from `motion`, that is, if no joint moves or stretches."""
    frames: NDArray[np.int64] | None = None
    """[K], indices of the frames to use, if the data set chooses them; None to use every n-th frame, as in the settings."""
    is_usable: NDArray[np.bool_] | None = None
    """[T], whether each frame may be used; None if all may."""

    def every(self, step: int) -> NDArray[np.int64]:
        """Return the indices [K] of the frames to use: those that the data set chooses, or the first usable of every `step`."""
        if self.frames is not None:
            return np.asarray(self.frames, np.int64)
        if self.is_usable is None:
            return np.arange(0, self.motion.num_frames, step)
        usable = np.flatnonzero(self.is_usable)
        return usable[np.unique(usable // step, return_index=True)[1]]


@dataclass(frozen=True, eq=False)
class SubjectData:
    """A subject: a skeleton and sequences of posed meshes."""

    data: str
    """Name of the data set."""
    subject: str
    """Id of the subject."""
    skeleton: Skeleton
    """Joints of this subject and the canonical pose."""
    sequences: tuple[SequenceSpec, ...]
    """Training, test and out-of-distribution sequences, in this order."""
    template: MeshTemplate | None = None
    """Mesh of the subject in the canonical pose, with skinning weights; None if the data set has none."""
    betas: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """[S], shape parameters of the body model; S is 0 without a body model."""
    sources: tuple[str, ...] = ()
    """Origin of the data, such as the file of the body; printed, and written to the manifest."""
    broken: tuple[tuple[str, str], ...] = ()
    """Name of each sequence that cannot be used, and the reason."""
    is_planar: bool = False
    """Whether the subject is two-dimensional: its meshes are prisms along z, and only the plane z = 0 is sampled."""
    warnings: tuple[str, ...] = ()
    """What should be checked before training; printed."""

    def of_split(self, split: Split) -> tuple[SequenceSpec, ...]:
        """Return the sequences of one split."""
        return tuple(sequence for sequence in self.sequences if sequence.split == split)


def body_template(body: Body, betas: NDArray[np.float64], skeleton: Skeleton) -> MeshTemplate:
    """Return the mesh of a body model in the skeleton's canonical pose.

    Args:
        body: the body model.
        betas: [S], shape parameters.
        skeleton: skeleton of the body with these shape parameters.
    """
    body = body.to(torch.float64)
    vertices = body.pose(skeleton.canonical_pose[None], betas).vertices[0]
    return MeshTemplate(vertices.numpy(), body.faces.numpy().astype(np.int32), body.weights.numpy())


def body_sequence(name: str, split: Split, motion: Motion, body: Body, betas: NDArray[np.float64]) -> SequenceSpec:
    """Return a sequence whose meshes are a body model in the poses of a motion; `betas` [S] are its shape parameters."""
    return SequenceSpec(name, split, motion, BodyMeshes(body, betas, motion.poses, motion.translation))
