"""Rigs that are fitted to scans in place of a body: a mesh in its rest pose, with joints, weights and, at best, motions."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.skinning import skin_vertices
from snarfcli.datasets.named_values import NamedValues
from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.datasets.rigged import RIG_SUFFIXES, bvh_skeleton, read_rigged_files
from snarfcli.datasets.skeleton_files import SkeletonFile, read_skeleton
from snarfcli.datasets.subject_size import near_bones
from snarfcli.errors import UserError
from snarfcli.formats.surfaces import SURFACE_SUFFIXES, read_surface
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.many_poses import posed_many
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.rest_weights import weights_of_bones
from snarfcli.registration.rotations import matrix_to_vector, nearest_rotations, vector_to_matrix
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.texts import counted

__all__ = ["SIZE_PER_BETA", "RigSurface", "read_rig"]

Array = NDArray[np.float64]

SIZE_PER_BETA = 0.1
"""The one shape parameter of a rig is its size: 1 makes it larger by this share."""

_SKELETON_SUFFIXES = (".json", ".npz", ".bvh")
_MESH = {"vertices": ("vertices", "v_template"), "faces": ("faces", "f"), "weights": ("weights", "skinning_weights")}
_POSES_PER_S = 8.0  # of the clips that become starts
_MEASURED = 300  # vertices, by which the size of scans is compared
_AROUND = 0.5  # share of the vertices of a mesh that are near the bones of its skeleton
_SUM_TOLERANCE = 1e-2  # as of bodies


@dataclass(frozen=True, eq=False)
class RigSurface:
    """A rigged mesh in its rest pose, y up."""

    skeleton: Skeleton
    """Joint tree with the joints in the rest pose."""
    vertices: Array
    """[V, 3], rest pose."""
    faces: NDArray[np.int64]
    """[F, 3], outward."""
    weights: Array
    """[V, J], rows sum to 1."""
    motions: tuple[tuple[str, Array], ...]
    """Names and poses [L, J, 3] of the rig's own motions, axis-angle, radians, some per second."""
    source: str
    """What was read, for messages."""

    @property
    def length_m(self) -> float:
        """Longest side of the mesh in the rest pose."""
        return float(np.ptp(self.vertices, axis=0).max())

    @property
    def digest(self) -> str:
        """Digest of the mesh and the joints."""
        parts = [(self.vertices, "<f4"), (self.faces, "<i8"), (self.skeleton.joints_rest.numpy(), "<f4")]
        return hashlib.sha256(b"".join(np.asarray(part, kind).tobytes() for part, kind in parts)).hexdigest()[:16]

    @cached_property
    def library(self) -> PoseLibrary:
        """The rest pose and the poses of the rig's own motions."""
        return self.library_without(())

    def library_without(self, names: Collection[str]) -> PoseLibrary:
        """Return the rest pose and the poses of the rig's own motions, without some of these."""
        poses = [poses for name, poses in self.motions if name not in names]
        return PoseLibrary.of_rig(self.skeleton.num_joints, np.concatenate(poses) if poses else None)

    def surface(self, count: int) -> BodySurface:
        """Return `count` vertices, spread evenly, with the size as the only shape parameter (see `SIZE_PER_BETA`)."""
        surface = BodySurface.from_rig(self.skeleton, self.vertices, self.faces, self.weights, count)
        grown = {
            "points_by_beta": SIZE_PER_BETA * surface.points_rest[..., None],
            "joints_by_beta": SIZE_PER_BETA * surface.joints_rest[..., None],
        }
        return replace(surface, **grown)

    def resized(self, factor: float) -> RigSurface:
        """Return the rig made larger by a factor about the origin."""
        skeleton = replace(self.skeleton, joints_rest=factor * self.skeleton.joints_rest)
        return replace(self, skeleton=skeleton, vertices=factor * self.vertices)

    def shaped(self, betas: Array) -> RigSurface:
        """Return the rig in the size that the shape parameters [1] say."""
        return self.resized(1 + SIZE_PER_BETA * float(betas[0]))

    def sized_to(self, scans: Sequence[ScanPoints]) -> RigSurface:
        """Return the rig about as large as what scans show: the spread of the points in them, and in the poses of the rig.

        Args:
            scans: of some frames, metres.
        """
        surface = self.surface(_MEASURED)
        points, _ = posed_many(surface, vector_to_matrix(self.library.poses), np.zeros(1))
        own = np.median([_spread(cloud) for cloud in points])
        return self.resized(float(np.median([_spread(scan.points) for scan in scans]) / own))

    def mesh(self, state: BodyState) -> tuple[Array, NDArray[np.int64]]:
        """Return the whole mesh in a state: vertices [V, 3], metres, and faces [F, 3]."""
        rig = self.shaped(state.betas)
        pose, translation = torch.from_numpy(state.pose[None]), torch.from_numpy(state.translation[None])
        transforms = rig.skeleton.to(torch.float64).posed_from_rest(pose, translation)[0].numpy()
        return skin_vertices(rig.vertices, rig.weights, transforms), self.faces


def read_rig(path: str | Path, mesh: str | Path | None = None) -> RigSurface:
    """Read a rig in the units of its file, y up.

    Args:
        path: a glTF file (also VRM) with a skin; or a skeleton file (`.json`, `.npz`, `.bvh`), with a mesh in the rest pose.
        mesh: the mesh of a skeleton file, in the same units and axes. Without it, it is the skeleton file's own `vertices` and
            `faces`, or the mesh file of the same name beside it. Weights are its `weights` [V, J], or follow from
            the distances to the bones.

    Raises:
        UserError: a file is missing or damaged, is none of these, has no skin or no mesh, or the mesh is not around the bones.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in RIG_SUFFIXES:
        if mesh is not None:
            raise UserError(f"skeleton {path}: wanted no mesh file, since it has its own mesh, got {mesh}; leave it out")
        return _rig_of_gltf(path)
    if suffix not in _SKELETON_SUFFIXES:
        wanted = ", ".join((*RIG_SUFFIXES[:3], *_SKELETON_SUFFIXES))
        raise UserError(f"skeleton {path}: wanted a file ending in {wanted}, got {suffix or 'no suffix'}; export it as .glb")
    return _rig_of_skeleton(path, None if mesh is None else Path(mesh))


def _rig_of_gltf(path: Path) -> RigSurface:
    rigged = read_rigged_files([path])
    skeleton = _skeleton(rigged.skeleton, FileToWorld(1.0, "y"), rigged.skeleton.idle)
    motions = tuple(
        (name, _poses(clip.posed_from_rest[:: max(1, round(clip.frame_rate / _POSES_PER_S))], skeleton))
        for name, clip in rigged.clips
        if clip.posed_from_rest is not None
    )
    joints, count = counted(skeleton.num_joints, "joint"), counted(len(motions), "motion")
    source = f"rig {path}: {joints}, {len(rigged.mesh.vertices)} vertices, {count}"
    return _rig(path, skeleton, rigged.mesh.vertices, rigged.mesh.faces, rigged.mesh.weights, motions, source)


def _rig_of_skeleton(path: Path, mesh: Path | None) -> RigSurface:
    file = bvh_skeleton(path) if path.suffix.lower() == ".bvh" else read_skeleton(path)
    own = None if path.suffix.lower() == ".bvh" else NamedValues(path, "skeleton file", _MESH)
    weights = None
    if mesh is None and own is not None and own.get("vertices") is not None:
        where = str(path)
        vertices, faces = own.numbers("vertices", (None, 3)), own.numbers("faces", (None, 3)).astype(np.int64)
        if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            own.fail(f"faces: wanted numbers from 0 to {len(vertices) - 1}, got others; repair it")
    else:
        mesh = mesh or next((path.with_suffix(s) for s in SURFACE_SUFFIXES if path.with_suffix(s).is_file()), None)
        if mesh is None:
            raise UserError(
                f"skeleton {path} has no mesh: wanted vertices and faces in it, or {path.stem}.obj (.ply, .glb, ...) beside it"
            )
        where = str(mesh)
        vertices, faces = read_surface(mesh)
    if own is not None and own.get("weights") is not None:
        weights = _given_weights(own, len(vertices), file)
    world = FileToWorld(file.scale or 1.0, file.up or "y")
    vertices, skeleton = world.points(vertices), _skeleton(file, world, ())
    joints = skeleton.joints_rest.numpy()
    if near_bones(vertices, joints, skeleton.parents).mean() < _AROUND:
        raise UserError(f"{where}: wanted a mesh around the joints of {path.name}, in its units and axes, got one elsewhere")
    made = "computed weights" if weights is None else "its weights"
    if weights is None:
        weights = weights_of_bones(skeleton, vertices, faces)
    idle = tuple(np.flatnonzero(~np.any(weights > 0, axis=0)).tolist())
    source = f"rig {path}: {counted(skeleton.num_joints, 'joint')}, {len(vertices)} vertices of {where}, {made}"
    return _rig(path, replace(skeleton, idle=idle), vertices, faces, weights, (), source)


def _given_weights(own: NamedValues, vertices: int, file: SkeletonFile) -> Array:
    """Return the weights [V, J] of a skeleton file, its joints in the order of the skeleton."""
    weights = own.numbers("weights", (None, len(file.names)))
    sums = weights.sum(1, keepdims=True)
    if len(weights) != vertices:
        own.fail(
            f"weights: wanted {vertices} rows, one per vertex of the mesh, got {len(weights)}; give the mesh that they are of"
        )
    if (weights < 0).any() or (np.abs(sums - 1) > _SUM_TOLERANCE).any():
        own.fail("weights: wanted 0 or more and a sum of 1 per vertex, got others; repair it")
    return (weights / sums)[:, file.order]


def _rig(
    path: Path,
    skeleton: Skeleton,
    vertices: Array,
    faces: NDArray,
    weights: Array,
    motions: tuple[tuple[str, Array], ...],
    source: str,
) -> RigSurface:
    if not np.ptp(vertices, axis=0).max(initial=0.0) > 0:
        raise UserError(f"skeleton {path}: wanted a mesh with an extent, got one without; export it again")
    return RigSurface(skeleton, np.asarray(vertices, np.float64), np.asarray(faces, np.int64), weights, motions, source)


def _skeleton(file: SkeletonFile, world: FileToWorld, idle: tuple[int, ...]) -> Skeleton:
    """Return a skeleton whose canonical pose is the rest pose, y up."""
    rest = torch.from_numpy(world.points(file.joints_rest))
    return Skeleton(file.names, file.parents, rest, torch.zeros_like(rest), idle)


def _poses(posed_from_rest: Array, skeleton: Skeleton) -> Array:
    """Return the poses [T, J, 3] of bone transforms [T, J, 4, 4]; joints that only place one other joint do not turn."""
    turns = nearest_rotations(posed_from_rest[..., :3, :3])
    above = np.stack([np.broadcast_to(np.eye(3), turns[:, 0].shape) if p < 0 else turns[:, p] for p in skeleton.parents], 1)
    rotations = above.transpose(0, 1, 3, 2) @ turns
    joint, children = 0, [j for j, parent in enumerate(skeleton.parents) if parent == 0]
    while joint in skeleton.idle and len(children) == 1:  # the root takes the turns of the first joint that moves something
        (joint,) = children
        rotations[:, 0], rotations[:, joint] = turns[:, joint], np.eye(3)
        children = [j for j, parent in enumerate(skeleton.parents) if parent == joint]
    return matrix_to_vector(rotations)


def _spread(points: Array) -> float:
    """Return the root mean square distance of points [N, 3] from their middle."""
    return float(np.sqrt(np.square(points - points.mean(0)).sum(1).mean()))
