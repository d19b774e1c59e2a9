"""Measure whether poses fit the meshes frame by frame: how far the surface near a bone moves relative to the bone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import igl
import numpy as np
import torch

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.sampling import uniform_surface_samples
from snarfcli.segments import segment_distances

__all__ = ["BonePosedMesh", "PoseConsistency", "measure_pose_consistency"]

_POINTS = 3000  # per frame
_FEWEST_POINTS = 8  # of a bone, in a frame
_END_SHARE = 0.2  # of a bone's length at each end, where the surface bends
_SHORTEST_BONE = 0.02  # share of the mesh's longest side; shorter bones have too few points
_SINGULAR = 1e-9  # determinant of a bone transform below which it is not inverted


class BonePosedMesh(Protocol):
    """A posed mesh with its bone transforms and posed joints."""

    @property
    def vertices(self) -> np.ndarray: ...
    @property
    def faces(self) -> np.ndarray: ...
    @property
    def joints(self) -> np.ndarray: ...
    @property
    def posed_from_rest(self) -> np.ndarray: ...


@dataclass(frozen=True)
class PoseConsistency:
    """How far the surface near a bone moves relative to the bone, from one frame to another."""

    moved_m: float
    """Median over frames of the median over bones, metres."""
    length_m: float
    """Median longest side of the meshes, metres."""
    bones: int
    """Number of bones with enough surface around them."""
    frames: int
    """Number of frames."""


def measure_pose_consistency(skeleton: Skeleton, frames: Sequence[BonePosedMesh]) -> PoseConsistency | None:
    """Measure how far the surface near each bone moves relative to the bone between frames.

    Surface points closest to the inner part of a bone are moved rigidly with this bone to the next frame, where their distance
    to the mesh is measured. With correct poses this is the deformation of flesh or cloth; a wrong angle or place of a bone in
    one of the frames moves the points off the surface. A bone may be outside the mesh, and the topology may differ between
    frames. Medians over the points of a bone, over bones and over frames ignore parts that do not follow their nearest bone.

    Args:
        skeleton: skeleton of the subject.
        frames: frames with different poses; the first follows the last.

    Returns:
        The result, the same in every call; None with fewer than two frames, or no bone with enough surface around it.
    """
    usable = [frame for frame in frames if np.isfinite(frame.posed_from_rest).all()]
    if len(usable) < 2:
        return None
    rest = skeleton.joints_rest.double()
    length = float(np.median([np.ptp(frame.vertices, axis=0).max() for frame in usable]))
    long = [(rest[end] - rest[start]).norm().item() >= _SHORTEST_BONE * length for start, end in skeleton.bones]
    per_frame, seen = [], np.zeros(len(long), bool)
    for index, frame in enumerate(usable):
        moved = _moved(skeleton, np.array(long, bool), frame, usable[(index + 1) % len(usable)], index)
        seen |= np.isfinite(moved)
        if np.isfinite(moved).any():
            per_frame.append(np.nanmedian(moved))
    return PoseConsistency(float(np.median(per_frame)), length, int(seen.sum()), len(usable)) if per_frame else None


def _moved(skeleton: Skeleton, long: np.ndarray, first: BonePosedMesh, second: BonePosedMesh, seed: int) -> np.ndarray:
    """Return per bone [S] the median distance of its moved points to the second mesh, metres; NaN with too few points."""
    result = np.full(len(long), np.nan)
    try:
        points = uniform_surface_samples(first.vertices, first.faces, _POINTS, np.random.default_rng(seed))
    except UserError:  # a mesh without area
        return result
    # Joints count as bones of length 0, so that a head or a hand is not taken as the end of the bone before it.
    ends = torch.tensor([*skeleton.bones, *((joint, joint) for joint in range(skeleton.num_joints))])
    nearest = segment_distances(torch.from_numpy(points), torch.from_numpy(first.joints)[ends]).argmin(1).numpy()
    bones, moved = [], []
    for bone, (start, end) in enumerate(skeleton.bones):
        if not long[bone] or abs(np.linalg.det(first.posed_from_rest[start])) < _SINGULAR:
            continue
        near, along = points[nearest == bone], first.joints[end] - first.joints[start]
        share = (near - first.joints[start]) @ along / max(float(along @ along), 1e-12)
        near = near[(share > _END_SHARE) & (share < 1 - _END_SHARE)]
        if len(near) < _FEWEST_POINTS:
            continue
        second_from_first = second.posed_from_rest[start] @ np.linalg.inv(first.posed_from_rest[start])
        bones.append(bone)
        moved.append(near @ second_from_first[:3, :3].T + second_from_first[:3, 3])
    if bones:
        vertices, faces = second.vertices.astype(np.float64), second.faces.astype(np.int64)
        squared = np.asarray(igl.point_mesh_squared_distance(np.concatenate(moved), vertices, faces)[0]).reshape(-1)
        parts = np.split(np.sqrt(squared), np.cumsum([len(points) for points in moved])[:-1])
        result[bones] = [np.median(part) for part in parts]
    return result
