"""A recorded sequence in the units and axes of its files, and its conversion to metres and y up."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import forward_kinematics, pose_from_transforms
from snarfcli.bodies.skeleton import Skeleton
from snarfcli.datasets.posed_meshes import FileMeshes, RigMeshes
from snarfcli.datasets.skeleton_files import PoseFile, SkeletonFile
from snarfcli.datasets.splits import Split, held_back_start
from snarfcli.datasets.subjects import SequenceSpec
from snarfcli.errors import UserError
from snarfcli.motions import Motion

__all__ = ["PERSON_M", "FileToWorld", "RecordedSequence", "check_scale", "person_scale"]

PERSON_M = 1.8
"""Longest side after scaling, metres: the lengths in the settings of training fit a person."""

_SCALE_LIMITS = (1e-6, 1e6)  # metres per unit, from micrometres to 1000 km
_NEAR_A_PERSON_M = (1.2, 2.4)
_FRAMES_AT_ONCE = 4096
_TOLERANCE_M = 1e-3  # poses that reproduce the bone transforms within a millimetre replace them


@dataclass(frozen=True)
class FileToWorld:
    """Conversion from the units and axes of the files to metres and y up."""

    scale: float
    """Metres per unit."""
    up: str
    """Up axis of the files: y or z."""

    @property
    def turn(self) -> NDArray[np.float64]:
        """[3, 3], rotation from the axes of the files; z up becomes y up, and facing -y becomes facing +z."""
        return np.eye(3) if self.up == "y" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[4, 4], rotation and scale from the files to metres and y up."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.turn
        return matrix

    def points(self, points: NDArray) -> NDArray[np.float64]:
        """Convert points or offsets [..., 3] of the files to metres."""
        return self.scale * (np.asarray(points, np.float64) @ self.turn.T)

    def angles(self, axis_angle: NDArray) -> NDArray[np.float64]:
        """Rotate axis-angle vectors [..., 3] of the files to y up."""
        return np.asarray(axis_angle, np.float64) @ self.turn.T

    def transforms(self, transforms: NDArray) -> NDArray[np.float64]:
        """Convert bone transforms [..., 4, 4] of the files to metres."""
        moved = np.array(transforms, np.float64)
        moved[..., :3, :3] = self.turn @ moved[..., :3, :3] @ self.turn.T
        moved[..., :3, 3] = self.points(moved[..., :3, 3])
        return moved


@dataclass(frozen=True, eq=False)
class RecordedSequence:
    """A sequence in the units and axes of its files."""

    name: str
    """Name of the sequence, which can be a folder name."""
    poses: PoseFile
    """Motion of the skeleton."""
    meshes: FileMeshes | RigMeshes
    """The mesh of every frame: files, which are converted when they are read, or a rig that is already converted."""

    @property
    def usable_frames(self) -> NDArray[np.int64]:
        """[K], indices of the frames whose poses are trusted."""
        is_trusted = self.poses.is_trusted
        return np.arange(self.poses.num_frames) if is_trusted is None else np.flatnonzero(is_trusted)

    def bone_transforms(self, frames: NDArray[np.int64], skeleton: SkeletonFile) -> NDArray[np.float64]:
        """Return the transforms [K, J, 4, 4] of the bones from rest to the frames with these indices [K], units of the file."""
        if self.poses.posed_from_rest is not None:
            return self.poses.posed_from_rest[frames]
        if self.poses.poses is None or self.poses.translation is None:
            raise ValueError(f"{self.name}: wanted bone transforms, or poses with a translation, got neither")
        poses, translation = (torch.from_numpy(array[frames]) for array in (self.poses.poses, self.poses.translation))
        return forward_kinematics(poses, torch.from_numpy(skeleton.joints_rest), skeleton.parents, translation)[1].numpy()

    def joints(self, frames: NDArray[np.int64], skeleton: SkeletonFile) -> NDArray[np.float64]:
        """Return the joints [K, J, 3] in the frames with these indices [K], units of the file."""
        joints = np.empty((len(frames), *skeleton.joints_rest.shape))
        for first in range(0, len(frames), _FRAMES_AT_ONCE):
            part = slice(first, first + _FRAMES_AT_ONCE)
            moved = self.bone_transforms(frames[part], skeleton)
            joints[part] = np.einsum("kjab,jb->kja", moved[..., :3, :3], skeleton.joints_rest) + moved[..., :3, 3]
        return joints

    def to_sequence(self, split: Split, skeleton: Skeleton, world: FileToWorld) -> SequenceSpec:
        """Return the converted sequence; bone transforms are kept only if the poses do not reproduce them."""
        poses, posed_from_rest = self.poses, None
        if poses.posed_from_rest is not None:
            transforms = world.transforms(poses.posed_from_rest)
            angles, translation, apart = (
                array.numpy()
                for array in pose_from_transforms(torch.from_numpy(transforms), skeleton.parents, skeleton.joints_rest)
            )
            posed_from_rest = transforms if apart.max() > _TOLERANCE_M else None
        elif poses.poses is not None and poses.translation is not None:
            angles, translation = world.angles(poses.poses), world.points(poses.translation)
        else:
            raise ValueError(f"{self.name}: wanted bone transforms, or poses with a translation, got neither")
        motion = Motion(self.name, angles, translation, poses.frame_rate)
        meshes = self.meshes
        if isinstance(meshes, FileMeshes):
            meshes = replace(meshes, world_from_file=world.matrix)
        return SequenceSpec(self.name, split, motion, meshes, posed_from_rest, is_usable=poses.is_trusted)

    def split_off_test(self) -> list[RecordedSequence]:
        """Return the sequence without the last fifth of its usable frames, and with these; a single frame is not split."""
        count, usable = self.poses.num_frames, self.usable_frames
        if len(usable) < 2:
            return [self]
        cut = int(usable[held_back_start(len(usable))])
        return [self._part(self.name, slice(0, cut)), self._part(f"{self.name}_end", slice(cut, count))]

    def _part(self, name: str, frames: slice) -> RecordedSequence:
        arrays = {key: getattr(self.poses, key) for key in ("poses", "translation", "posed_from_rest", "is_trusted")}
        poses = replace(self.poses, **{key: array[frames] for key, array in arrays.items() if array is not None})
        if isinstance(self.meshes, FileMeshes):
            return RecordedSequence(name, poses, self.meshes.chosen(np.arange(len(self.meshes))[frames]))
        return RecordedSequence(name, poses, replace(self.meshes, posed_from_rest=self.meshes.posed_from_rest[frames]))


def person_scale(length: float, whole: float, wanted: str, given: float | None) -> tuple[float, str]:
    """Return the metres per unit, and the reason as text.

    Args:
        length: longest side of the subject, units of its file.
        whole: longest side of its mesh, units of its file; larger than `length` if the mesh shows more than the subject.
        wanted: the setting data.scale: auto, or a positive number.
        given: scale of the skeleton file; None if it has none.
    """
    if wanted != "auto":
        return float(wanted), f"scaled by {float(wanted):g} (data.scale): {float(wanted) * length:.2f} m long"
    if given is not None:
        return given, f"scaled by {given:g} (its file): {given * length:.2f} m long"
    part = f" near the bones, the whole mesh {whole:.4g} units" if whole > length else ""
    if _NEAR_A_PERSON_M[0] <= length <= _NEAR_A_PERSON_M[1] or not length > 0:
        return 1.0, f"not scaled: {length:.2f} m long{part}" + ("; data.scale=NUMBER sets it" if part else "")
    scale = PERSON_M / length
    return scale, f"scaled by {scale:.4g}, so {length:.4g} units{part} become {PERSON_M} m; data.scale=NUMBER sets it"


def check_scale(wanted: str) -> None:
    """Check the setting data.scale.

    Raises:
        UserError: it is neither auto nor a number of metres in range.
    """
    if wanted == "auto":
        return
    try:
        scale = float(wanted)
    except ValueError:
        scale = math.nan
    if not _SCALE_LIMITS[0] <= scale <= _SCALE_LIMITS[1]:
        limits = f"from {_SCALE_LIMITS[0]:g} to {_SCALE_LIMITS[1]:g}"
        raise UserError(f"data.scale: wanted auto or metres per unit {limits}, got '{wanted}'")
