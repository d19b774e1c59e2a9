"""The skinned surface: one canonical mesh that follows the pose-dependent shape and is moved by linear blend skinning."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.mesh import Mesh, vertex_normals
from snarfcli.meshing.surfaces import canonical_surface, check_posed, in_chunks
from snarfcli.models.trained_field import TrainedField

__all__ = ["Followed", "SkinnedSurface", "skinned_surface"]

# The pose-dependent motion of the shape is computed at the vertices of a coarser mesh, 2 cm apart on a body, and interpolated.
# Compared with computing it at every vertex at resolution 256, the mean error is 0.2 to 0.4 mm (benchmarks/bm_surfaces.py).
_CONTROL_RESOLUTION = 96
_STEPS = 8  # maximum number of steps along a normal
_FEWEST = 0.005  # share of the points at which the search stops: the last ones are in creases and get little trust
_REACHED_M = 1e-4  # a shorter step ends the search of a point; the mean is two evaluations per point
_LOST_M = 1e-3  # a point whose last step was longer has no level set along its normal
_SLOPE_M = 0.002  # half the distance over which the slope along a normal is measured
_LEAST_SLOPE = 3.0  # logits per metre; a flatter field has no surface to follow
_LONGEST_STEP_M = 0.01
_FARTHEST_M = 0.03  # maximum distance that the pose moves a point of the canonical surface along its normal
# Distance from the mean of its neighbours at which a point gets less trust. The shape moves smoothly, but in creases a normal
# meets the surface of the other side, or none, in one frame and not in the next. With this, none of 1.7 million motions of a
# vertex between two frames of jumping jacks is longer than 5 mm; without, 430 are (benchmarks/bm_surfaces.py).
_OUTLIER_M = 0.003
_FILLINGS = 20  # rounds in which points without a level set take the mean of their neighbours
_ROUNDS = 5  # rounds of smoothing
_PULL = 0.1  # weight of the neighbours for a point that agrees with them
_MOST_LOST = 0.5  # with a larger share of lost points the pose has no surface


class SkinnedSurface:
    """A canonical mesh of an avatar that is made once and posed many times, always with the same faces.

    In each pose the vertices move along their canonical normals onto the level set of the shape of that pose, and then by
    linear blend skinning with the weights of `mesh`, as in a rig.

    Args:
        avatar: gives the canonical shape and the skinning weights.
        resolution: number of cells along the longest side of the canonical box.
        keep_share: see `extract_surface`.
        mesh: canonical mesh to use instead, for example a decimated one; its vertices are first moved onto the level set,
            and get the weights there.

    Raises:
        EmptySurface, FullSurface: the canonical field has no surface.
        ValueError: the avatar has no skinning weights.

    Source: S Eq. 2 (the level set of the shape under the condition of a pose) and S Eq. 4.
    """

    def __init__(
        self, avatar: TrainedField, resolution: int = 256, *, keep_share: float = 0.01, mesh: Mesh | None = None
    ) -> None:
        self._avatar = avatar
        rest = avatar.skeleton.canonical_pose.float()
        fine = canonical_surface(avatar, rest, resolution, keep_share=keep_share) if mesh is None else mesh
        self.mesh = fine = _settled(avatar, rest, fine)
        """The canonical mesh, in the shape of the skeleton's canonical pose, with weights [V, J] and normals."""
        coarse = None
        if mesh is not None or resolution > _CONTROL_RESOLUTION:
            coarse = _settled(avatar, rest, canonical_surface(avatar, rest, _CONTROL_RESOLUTION, keep_share=keep_share))
        if coarse is None or len(coarse.vertices) >= len(fine.vertices):
            self.control, self._spread = Followed(avatar, rest, fine), None
        else:
            self.control, self._spread = Followed(avatar, rest, coarse), _nearest_points(fine.vertices, coarse)

    @torch.no_grad()
    def canonical_vertices(self, pose: Tensor) -> NDArray[np.float32]:
        """Return the vertices [V, 3], canonical frame, metres, on the level set of the shape in `pose` [J, 3].

        Raises:
            EmptySurface: in this pose the shape has no surface near most of the vertices.
        """
        return self.mesh.vertices + self.spread(self.control.ways(pose.float()))[:, None] * self.mesh.unit_normals

    def spread(self, way: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the ways of the vertices [V], interpolated from those of the control points [C], metres along the normals."""
        if self._spread is None:
            return way
        corners, shares = self._spread
        return np.einsum("vc,vc->v", way[corners], shares)

    @torch.no_grad()
    def posed(self, pose: Tensor, translation: Tensor | None = None, transforms: Tensor | None = None) -> Mesh:
        """Return the mesh in one pose, with weights and normals.

        Args:
            pose: [J, 3] axis-angle, radians, global orientation included.
            translation: [3], metres.
            transforms: [J, 4, 4], canonical to posed, metres, instead of those of the pose; for joints that stretch.

        Raises:
            EmptySurface: in this pose the shape has no surface near most of the vertices.
        """
        pose, transforms = check_posed(self._avatar, pose, translation, transforms)
        vertices = skin_vertices(self.canonical_vertices(pose), self.mesh.skinning_weights, transforms.cpu().numpy())
        return replace(self.mesh, vertices=vertices, normals=vertex_normals(vertices, self.mesh.faces))


def skinned_surface(avatar: TrainedField, resolution: int = 256, keep_share: float = 0.01) -> SkinnedSurface:
    """Return the skinned surface of an avatar, computed once per resolution and share and cached in the avatar.

    Args:
        avatar: gives the canonical shape and the skinning weights.
        resolution: voxels along the longest side of the canonical box.
        keep_share: a connected surface with fewer faces than this share of the largest one is dropped.

    Raises:
        EmptySurface, FullSurface: the canonical field has no surface.
        ValueError: the avatar has no skinning weights.
    """
    key = ("skinned_surface", resolution, keep_share)
    return avatar.derived(key, lambda: SkinnedSurface(avatar, resolution, keep_share=keep_share))


class Followed:
    """Points of the canonical surface, followed along their normals as the pose changes the shape."""

    def __init__(self, avatar: TrainedField, pose: Tensor, mesh: Mesh) -> None:
        self.avatar = avatar
        self.points = mesh.vertices
        self.normals = mesh.unit_normals
        self.neighbours = _neighbours(mesh)
        every = np.arange(len(self.points))
        ahead, behind = (self.logits(pose, every, np.full(len(every), way, np.float32)) for way in (_SLOPE_M, -_SLOPE_M))
        self.slope = np.minimum((ahead - behind) / (2 * _SLOPE_M), -_LEAST_SLOPE)  # logits fall towards the outside

    def logits(self, pose: Tensor, index: NDArray[np.int64], way: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the logits [K] in a pose at the points with indices [K], moved along their normals by `way` [K], metres."""
        points_c = self.points[index] + way[:, None] * self.normals[index]
        return in_chunks(lambda part: self.avatar.canonical_logits(part, pose), points_c)

    def ways(self, pose: Tensor) -> NDArray[np.float32]:
        """Return the distance of the level set from each point, [C], metres along its normal.

        Raises:
            EmptySurface: most points have no level set near them.
        """
        way, last_step = self.nearest_ways(pose)
        lost = float(np.mean(np.abs(last_step) > _LOST_M))
        if lost > _MOST_LOST:
            share = f"{100 * lost:.0f} % of the mesh"
            raise EmptySurface(f"the shape of this pose has no surface within {100 * _FARTHEST_M:g} cm of {share}")
        # Points without a level set, or with one unlike all around them, follow their neighbours. Trust fades gradually: a
        # point with full trust in one frame and none in the next would jump.
        found = 1 / (1 + (last_step / _LOST_M) ** 2)
        smooth = way * found
        for _ in range(_FILLINGS):
            smooth = found * way + (1 - found) * (self.neighbours @ smooth)
        for _ in range(_ROUNDS):
            around = self.neighbours @ smooth
            trust = found / (1 + ((way - around) / _OUTLIER_M) ** 4)
            smooth = (trust * way + _PULL * around) / (trust + _PULL)
        return smooth.astype(np.float32)

    def nearest_ways(self, pose: Tensor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where the search of each point ended and the length of its last step, both [C], metres along its normal.

        The search is Newton's method with the slope at rest, then secants; neighbours have no influence.
        """
        way = np.zeros(len(self.points), dtype=np.float32)
        last_step = np.zeros_like(way)
        left = np.arange(len(way))  # points whose search has not ended
        slope, before, last = self.slope, way.copy(), None
        for _ in range(_STEPS):
            value = self.logits(pose, left, way[left])
            if last is not None:
                # The slope of the last step, within a factor of the one at rest.
                moved = way[left] - before
                secant = np.divide(value - last, moved, out=slope.copy(), where=moved != 0)
                slope = np.clip(secant, 3 * self.slope[left], self.slope[left] / 3)
            before = way[left]
            step = np.clip(-value / slope, -_LONGEST_STEP_M, _LONGEST_STEP_M)
            way[left] = np.clip(before + step, -_FARTHEST_M, _FARTHEST_M)
            last_step[left] = step
            going = np.abs(step) > _REACHED_M
            left = left[going]
            before, last, slope = before[going], value[going], slope[going]
            if len(left) <= _FEWEST * len(way):
                break
        return way, last_step


def _neighbours(mesh: Mesh) -> csr_matrix:
    """Return the matrix [V, V] that averages over the neighbours of each vertex."""
    start, end = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    count = len(mesh.vertices)
    ones = np.ones(2 * len(start), dtype=np.float32)
    joined = csr_matrix((ones, (np.concatenate([start, end]), np.concatenate([end, start]))), shape=(count, count))
    joined.data[:] = 1  # an edge of two faces is counted twice
    return csr_matrix(diags(1 / np.maximum(np.asarray(joined.sum(axis=1)).ravel(), 1)) @ joined, dtype=np.float32)


def _settled(avatar: TrainedField, pose: Tensor, mesh: Mesh) -> Mesh:
    """Return a canonical mesh with its vertices on the level set of the shape in `pose`, with weights and normals."""
    mesh = mesh.with_normals()
    way, last_step = Followed(avatar, pose, mesh).nearest_ways(pose)
    way = np.where(np.abs(last_step) > _LOST_M, 0, way)
    vertices = mesh.vertices + way[:, None] * mesh.unit_normals
    weights = in_chunks(avatar.skinning_weights, vertices)
    return replace(mesh, vertices=vertices, weights=weights, normals=None).with_normals()


def _nearest_points(vertices: NDArray[np.float32], mesh: Mesh) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the corners [V, 3] of the triangle nearest to each vertex, and their shares [V, 3] in the nearest point."""
    corners = mesh.vertices.astype(np.float64)
    _, face, nearest = igl.point_mesh_squared_distance(vertices.astype(np.float64), corners, mesh.faces.astype(np.int64))
    index = mesh.faces[np.asarray(face).ravel()]
    a, b, c = (np.ascontiguousarray(corners[index[:, k]]) for k in range(3))
    shares = igl.barycentric_coordinates(np.ascontiguousarray(nearest), a, b, c)
    return index, np.asarray(shares, dtype=np.float32)
