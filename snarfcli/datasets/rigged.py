"""Rigged files as subjects: the skeleton, the skin and the motions of one or more glTF or BVH files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.datasets.skeleton_files import PoseFile, SkeletonFile
from snarfcli.errors import UserError
from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.gltf import read_gltf
from snarfcli.formats.rig import Rig, RigMesh

__all__ = ["RIG_SUFFIXES", "RiggedFiles", "bvh_poses", "bvh_skeleton", "read_rigged_files"]

RIG_SUFFIXES = (".glb", ".gltf")
"""Of files that hold a skeleton, a skin and animations."""

_SAME_PLACE = 0.01  # of the skeleton's size: rest joints further apart than this are of another skeleton


@dataclass(frozen=True, eq=False)
class RiggedFiles:
    """What rigged files of one skeleton hold together, in their units and axes."""

    skeleton: SkeletonFile
    """The joints that move the mesh, and those between them."""
    mesh: RigMesh
    """The mesh at rest, weights of these joints."""
    clips: tuple[tuple[str, PoseFile], ...]
    """The motions by name, as bone transforms."""
    dropped: tuple[str, ...]
    """Last joints that move no vertex, which were left out."""


def read_rigged_files(paths: Sequence[Path]) -> RiggedFiles:
    """Read glTF files of one skeleton: the mesh of the first that has one, the animations of all.

    Last joints that move no vertex (the ends of fingers, tools, helpers) are left out, again and again until each last joint
    moves something: a joint costs weights everywhere, and these have none.

    Raises:
        UserError: a file cannot be read, has another skeleton than the one with the mesh, or none has a mesh.
    """
    rigs = {path: read_gltf(path) for path in paths}
    path = next((path for path, rig in rigs.items() if rig.mesh is not None), None)
    if path is None:
        raise UserError(f"{paths[0]} has no mesh that its joints move; export it with its skin, or give meshes as files")
    first = rigs[path]
    kept = _moving_joints(first, first.mesh.weights)
    clips = []
    for other, rig in rigs.items():
        if not rig.clips:
            continue
        columns = _same_joints(path, first, other, rig, kept)
        for clip in rig.clips:
            name = clip.name
            if len(paths) > 1:  # animation tools give the only clip of every file the same name
                name = other.stem if len(rig.clips) == 1 else f"{other.stem}_{clip.name}"
            # The mesh is bound where the first file says; where the others stand at rest does not matter.
            moved = clip.world_from_joint[:, columns] @ np.linalg.inv(first.rest[kept])
            clips.append((name, PoseFile(clip.frame_rate, posed_from_rest=moved)))
    dropped = tuple(name for joint, name in enumerate(first.names) if joint not in set(kept.tolist()))
    mesh = RigMesh(first.mesh.vertices, first.mesh.faces, first.mesh.weights[:, kept])
    return RiggedFiles(_skeleton(first, kept), mesh, tuple(clips), dropped)


def bvh_skeleton(path: Path) -> SkeletonFile:
    """Return the skeleton of a BVH file, without the ends of the last bones, which never turn.

    Raises:
        UserError: the file cannot be read.
    """
    rig = read_bvh(path)
    return _skeleton(rig, _without_ends(rig))


def bvh_poses(path: Path, skeleton: SkeletonFile) -> PoseFile:
    """Return the motion of a BVH file as bone transforms of a skeleton whose joints it names.

    Raises:
        UserError: the file cannot be read, has no frames, lacks a joint, or has it elsewhere at rest.
    """
    rig = read_bvh(path)
    missing = [name for name in skeleton.names if name not in rig.names]
    if missing:
        raise UserError(f"BVH file {path} has no joint {missing[0]!r:.60}, which the skeleton has; give another")
    columns = np.array([rig.names.index(name) for name in skeleton.names])
    rest = rig.rest[columns, :3, 3]
    size = max(float(np.ptp(skeleton.joints_rest, axis=0).max()), 1e-9)
    # Where the whole skeleton stands at rest is nobody's business: the motion says where it goes.
    apart = np.abs((rest - rest[0]) - (skeleton.joints_rest - skeleton.joints_rest[0])).max(1)
    if apart.max() > _SAME_PLACE * size:
        raise UserError(
            f"BVH file {path} has joint {skeleton.names[apart.argmax()]!r:.60} elsewhere at rest than the skeleton "
            f"({apart.max():.3g} units apart); give one of the same skeleton"
        )
    if not rig.clips:
        raise UserError(f"BVH file {path} has no frames; export it with its motion")
    moved = rig.clips[0].world_from_joint[:, columns].copy()
    here = np.tile(np.eye(4), (len(columns), 1, 1))
    here[:, :3, :3], here[:, :3, 3] = rig.rest[columns, :3, :3], skeleton.joints_rest
    return PoseFile(rig.clips[0].frame_rate, posed_from_rest=moved @ np.linalg.inv(here))


def _skeleton(rig: Rig, kept: NDArray[np.int64]) -> SkeletonFile:
    place = {int(joint): number for number, joint in enumerate(kept)}
    return SkeletonFile(
        tuple(rig.names[joint] for joint in kept),
        tuple(place[rig.parents[joint]] if rig.parents[joint] >= 0 else -1 for joint in kept),
        rig.rest[kept, :3, 3],
        np.arange(len(kept)),
    )


def _moving_joints(rig: Rig, weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the joints that move a vertex, or have one below them that does; the first always stays."""
    needed = (weights > 0).any(0)
    needed[0] = True
    for joint in range(len(needed) - 1, 0, -1):  # the children come after their parent
        if needed[joint] and rig.parents[joint] >= 0:
            needed[rig.parents[joint]] = True
    return np.flatnonzero(needed)


def _without_ends(rig: Rig) -> NDArray[np.int64]:
    parents = set(rig.parents)
    ends = [
        joint not in parents and parent >= 0 and rig.names[joint].startswith(f"{rig.names[parent]}_end")
        for joint, parent in enumerate(rig.parents)
    ]
    return np.flatnonzero(~np.array(ends))


def _same_joints(path: Path, first: Rig, other: Path, rig: Rig, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where another file has the joints of the first, which must be as far apart there."""
    missing = [first.names[joint] for joint in kept if first.names[joint] not in rig.names]
    if missing:
        raise UserError(f"{other} has no joint {missing[0]!r:.60}, which {path.name} has; give each skeleton its own folder")
    columns = np.array([rig.names.index(first.names[joint]) for joint in kept])
    lengths = [
        np.linalg.norm(rest[:, :3, 3] - rest[parents, :3, 3], axis=1)
        for rest, parents in ((first.rest[kept], _parents(first, kept)), (rig.rest[columns], _parents(first, kept)))
    ]
    apart = np.abs(lengths[0] - lengths[1])
    if apart.max() > _SAME_PLACE * max(float(np.ptp(first.rest[kept, :3, 3], axis=0).max()), 1e-9):
        joint = first.names[kept[apart.argmax()]]
        raise UserError(f"{other} has {joint!r:.60} at another distance of its parent than {path.name}; export all alike")
    return columns


def _parents(rig: Rig, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the place of each kept joint's parent among the kept ones, its own for a root."""
    place = {int(joint): number for number, joint in enumerate(kept)}
    return np.array([place[rig.parents[joint]] if rig.parents[joint] >= 0 else place[int(joint)] for joint in kept])
