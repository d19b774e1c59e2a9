"""Read rigged files as subjects: skeleton, skin and motions of one or more glTF or BVH files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.datasets.skeleton_files import PoseFile, SkeletonFile
from snarfcli.errors import UserError
from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.gltf import GLTF_SUFFIXES, read_gltf
from snarfcli.formats.rig import Rig, RigMesh

__all__ = ["RIG_SUFFIXES", "RiggedFiles", "bvh_poses", "bvh_skeleton", "read_rigged_files"]

RIG_SUFFIXES = GLTF_SUFFIXES
"""Suffixes of files that can have a skeleton, a skin and animations."""

_LEAST_SCALE = 0.01  # of a joint, as a share of the largest; artists squash parts to 0.2, and hide them by less than 0.001
_SAME_PLACE = 0.01  # share of the skeleton's size; if rest joints differ by more, the skeletons differ


@dataclass(frozen=True, eq=False)
class RiggedFiles:
    """The common content of rigged files of one skeleton, in their units and axes."""

    skeleton: SkeletonFile
    """The joints that move the mesh, and the joints between them."""
    mesh: RigMesh
    """The mesh at rest, with weights of these joints."""
    clips: tuple[tuple[str, PoseFile], ...]
    """Name and bone transforms of each motion."""
    dropped: tuple[str, ...]
    """Names of the end joints without vertices, which were left out."""
    left_out: tuple[tuple[str, str], ...]
    """Name of each motion that cannot be used, and the reason."""


def read_rigged_files(paths: Sequence[Path]) -> RiggedFiles:
    """Read glTF files of one skeleton: the mesh of the first that has one, the animations of all.

    End joints that move no vertex (ends of fingers, tools, helpers) are left out repeatedly until every end joint moves a
    vertex, since each joint needs a weight at every point.

    Raises:
        UserError: no file can be read, a file has another skeleton than the file with the mesh, or no file has a mesh.
    """
    rigs, left_out = _readable(paths)
    skinned = next(((path, rig, rig.mesh) for path, rig in rigs.items() if rig.mesh is not None), None)
    if skinned is None:
        raise UserError(f"{paths[0]} has no mesh that its joints move; export it with its skin, or give meshes as files")
    path, first, whole = skinned
    kept = _moving_joints(first, whole.weights)
    clips = []
    for other, rig in rigs.items():
        left_out += rig.left_out
        if not rig.clips:
            continue
        columns = _same_joints(path, first, other, rig, kept)
        for clip in rig.clips:
            name = clip.name
            if len(paths) > 1:  # animation tools give the clip of every file the same name
                name = other.stem if len(rig.clips) == 1 else f"{other.stem}_{clip.name}"
            # The bind pose is that of the file with the mesh; the rest poses of the others do not matter.
            moved = clip.world_from_joint[:, columns] @ np.linalg.inv(first.rest[kept])
            hidden = _hidden(moved)
            if hidden is None:
                clips.append((name, PoseFile(clip.frame_rate, posed_from_rest=moved)))
            else:
                joint = first.names[kept[hidden[1]]]
                left_out.append((name, f"joint {joint!r:.60} has scale 0 in frame {hidden[0]}, so a part of the mesh vanishes"))
    dropped = tuple(name for joint, name in enumerate(first.names) if joint not in set(kept.tolist()))
    mesh = RigMesh(whole.vertices, whole.faces, whole.weights[:, kept])
    idle = tuple(np.flatnonzero(~np.any(mesh.weights > 0, axis=0)).tolist())
    return RiggedFiles(replace(_skeleton(first, kept), idle=idle), mesh, tuple(clips), dropped, tuple(left_out))


def _readable(paths: Sequence[Path]) -> tuple[dict[Path, Rig], list[tuple[str, str]]]:
    """Return the rigs of the files that can be read; and name and reason of the others, whose motions are left out."""
    rigs: dict[Path, Rig] = {}
    left_out: list[tuple[str, str]] = []
    problem = None
    for path in paths:
        try:
            rigs[path] = read_gltf(path)
        except UserError as error:
            problem = problem or error
            left_out.append((path.stem, str(error)))
    if problem is not None and not any(rig.mesh is not None for rig in rigs.values()):
        raise problem
    return rigs, left_out


def bvh_skeleton(path: Path) -> SkeletonFile:
    """Return the skeleton of a BVH file without End Sites, which never rotate.

    Raises:
        UserError: the file cannot be read.
    """
    rig = read_bvh(path)
    return _skeleton(rig, _without_ends(rig))


def bvh_poses(path: Path, skeleton: SkeletonFile) -> PoseFile:
    """Return the motion of a BVH file as bone transforms of a skeleton, matched by joint names.

    Raises:
        UserError: the file cannot be read, has no frames, lacks a joint, or has a joint elsewhere at rest.
    """
    rig = read_bvh(path)
    missing = [name for name in skeleton.names if name not in rig.names]
    if missing:
        raise UserError(f"BVH file {path} has no joint {missing[0]!r:.60}, which the skeleton has; give another")
    columns = np.array([rig.names.index(name) for name in skeleton.names])
    rest = rig.rest[columns, :3, 3]
    size = max(float(np.ptp(skeleton.joints_rest, axis=0).max()), 1e-9)
    # The position of the whole skeleton at rest does not matter; the motion defines it.
    apart = np.abs((rest - rest[0]) - (skeleton.joints_rest - skeleton.joints_rest[0])).max(1)
    if apart.max() > _SAME_PLACE * size:
        raise UserError(
            f"BVH file {path}: joint {skeleton.names[apart.argmax()]!r:.60} at rest: wanted the position of the skeleton, "
            f"got one {apart.max():.3g} units away; give a file of the same skeleton"
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
    """Return the joints that move a vertex or have a descendant that does, and joint 0."""
    needed: NDArray[np.bool_] = np.any(weights > 0, axis=0)
    needed[0] = True
    for joint in range(len(needed) - 1, 0, -1):  # children come after their parents
        if needed[joint] and rig.parents[joint] >= 0:
            needed[rig.parents[joint]] = True
    return np.flatnonzero(needed)


def _hidden(moved: NDArray[np.float64]) -> tuple[int, int] | None:
    """Return frame and joint of the first of the transforms [T, J, 4, 4] that shrinks a part to almost nothing; or None."""
    sizes = np.linalg.svd(moved[..., :3, :3], compute_uv=False)[..., -1]
    found = np.argwhere(sizes < _LEAST_SCALE * sizes.max(initial=0.0))
    return (int(found[0, 0]), int(found[0, 1])) if len(found) else None


def _without_ends(rig: Rig) -> NDArray[np.int64]:
    parents = set(rig.parents)
    ends = [
        joint not in parents and parent >= 0 and rig.names[joint].startswith(f"{rig.names[parent]}_end")
        for joint, parent in enumerate(rig.parents)
    ]
    return np.flatnonzero(~np.array(ends))


def _same_joints(path: Path, first: Rig, other: Path, rig: Rig, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of the first file's joints in another file; distances to the parents must agree."""
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
        raise UserError(
            f"{other}: {joint!r:.60}: wanted the distance to its parent of {path.name}, got another; export all alike"
        )
    return columns


def _parents(rig: Rig, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of each kept joint's parent among the kept joints; the joint itself for a root."""
    place = {int(joint): number for number, joint in enumerate(kept)}
    return np.array([place[rig.parents[joint]] if rig.parents[joint] >= 0 else place[int(joint)] for joint in kept])
