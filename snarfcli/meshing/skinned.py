"""The skinned surface: one canonical mesh, made once, that follows the pose-dependent shape and is moved by its skin."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.meshing.extract import EmptySurface
from snarfcli.meshing.mesh import Mesh, vertex_normals
from snarfcli.meshing.surfaces import canonical_surface, check_posed, in_chunks
from snarfcli.models.trained_field import TrainedField

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

__all__ = ["Followed", "SkinnedSurface", "skinned_surface"]

# The motion of the shape with the pose is found at the vertices of a coarser mesh, 2 cm apart on a body, and interpolated:
# against finding it at every vertex of a mesh of 256, 0.2 to 0.4 mm off in the mean (benchmarks/bm_surfaces.py).
_CONTROL_RESOLUTION = 96
_STEPS = 8
_FEWEST = 0.005  # share of the points that are not worth another step: they are in creases, and will hardly be believed
_REACHED_M = 1e-4  # a step this short ends the search; two evaluations a point suffice in the mean
_LOST_M = 1e-3  # a point whose last step was longer has no level set along its normal
_SLOPE_M = 0.002  # half the distance over which the slope along a normal is measured
_LEAST_SLOPE = 3.0  # logits a metre; what is flatter shows no surface to follow
_LONGEST_STEP_M = 0.01
_FARTHEST_M = 0.03  # that the pose may move a point of the canonical surface along its normal
# How far a point may be from the mean of its neighbours before it is believed less. The shape moves smoothly, but in creases a
# normal meets the surface of the other side, or none, and may do so in one frame and not in the next.
# So, of 1.7 million motions of a vertex from one frame to the next, none is longer than 5 mm instead of 430 in jumping jacks
# (benchmarks/bm_surfaces.py).
_OUTLIER_M = 0.003
_FILLINGS = 20  # rounds in which points that found nothing take the mean of their neighbours
_ROUNDS = 5  # of smoothing
_PULL = 0.1  # weight of the neighbours beside a point that agrees with them
_MOST_LOST = 0.5  # share of lost points beyond which there is no surface to speak of


class SkinnedSurface:
    """A canonical mesh of an avatar that is made once and posed again and again, always with the same faces.

    In each pose the vertices move along their canonical normals onto the level set of the shape of that pose, and then as
    linear blend skinning says, with the weights that they have in `mesh`: a rig can do the same.

    Args:
        avatar: gives the canonical shape and the skinning weights.
        resolution: cells along the longest side of the canonical box.
        keep_share: see `extract_surface`.
        mesh: canonical mesh to use instead, a decimated one for instance; its vertices are moved onto the level set first,
            and get the weights that they have there.

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
            self.control, self._corners, self._shares = Followed(avatar, rest, fine), None, None
        else:
            self.control = Followed(avatar, rest, coarse)
            self._corners, self._shares = _nearest_points(fine.vertices, coarse)

    @torch.no_grad()
    def canonical_vertices(self, pose: Tensor) -> NDArray[np.float32]:
        """Return the vertices [V, 3], canonical frame, metres, on the level set of the shape in `pose` [J, 3].

        Raises:
            EmptySurface: in this pose the shape has no surface near most of the vertices.
        """
        return self.mesh.vertices + self.spread(self.control.ways(pose.float()))[:, None] * self.mesh.normals

    def spread(self, way: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the ways of the vertices [V] between those of the control points [C], metres along the normals."""
        return way if self._corners is None else np.einsum("vc,vc->v", way[self._corners], self._shares)

    @torch.no_grad()
    def posed(self, pose: Tensor, translation: Tensor | None = None, transforms: Tensor | None = None) -> Mesh:
        """Return the mesh in one pose, with weights and normals.

        Args:
            pose: [J, 3] axis-angle, radians, global orientation included.
            translation: [3] metres.
            transforms: [J, 4, 4] canonical to posed, metres, instead of those of the pose; for joints that stretch.

        Raises:
            EmptySurface: in this pose the shape has no surface near most of the vertices.
        """
        pose, transforms = check_posed(self._avatar, pose, translation, transforms)
        vertices = skin_vertices(self.canonical_vertices(pose), self.mesh.weights, transforms.cpu().numpy())
        return replace(self.mesh, vertices=vertices, normals=vertex_normals(vertices, self.mesh.faces))


def skinned_surface(avatar: TrainedField, resolution: int = 256, keep_share: float = 0.01) -> SkinnedSurface:
    """Return the skinned surface of an avatar, computed once per resolution and share and kept with the avatar.

    Args:
        avatar: gives the canonical shape and the skinning weights.
        resolution: voxels along the longest side of the canonical box.
        keep_share: loose pieces with fewer faces than this share of the largest surface's are dropped.

    Raises:
        EmptySurface, FullSurface: the canonical field has no surface.
        ValueError: the avatar has no skinning weights.
    """
    key = ("skinned_surface", resolution, keep_share)
    return avatar.derived(key, lambda: SkinnedSurface(avatar, resolution, keep_share=keep_share))


class Followed:
    """Points of the canonical surface that are followed along their normals as the pose changes the shape."""

    def __init__(self, avatar: TrainedField, pose: Tensor, mesh: Mesh) -> None:
        self.avatar = avatar
        self.points = mesh.vertices
        self.normals = mesh.normals
        self.neighbours = _neighbours(mesh)
        every = np.arange(len(self.points))
        ahead, behind = (self.logits(pose, every, np.full(len(every), way, np.float32)) for way in (_SLOPE_M, -_SLOPE_M))
        self.slope = np.minimum((ahead - behind) / (2 * _SLOPE_M), -_LEAST_SLOPE)  # logits fall towards the outside

    def logits(self, pose: Tensor, index: NDArray[np.int64], way: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the logits [K] at some of the points [K], moved so far along their normals [K], in a pose."""
        points_c = self.points[index] + way[:, None] * self.normals[index]
        return in_chunks(lambda part: self.avatar.canonical_logits(part, pose), points_c)

    def ways(self, pose: Tensor) -> NDArray[np.float32]:
        """Return how far along its normal each point meets the level set, [C], metres.

        Raises:
            EmptySurface: most of them meet none.
        """
        way, last_step = self.nearest_ways(pose)
        lost = float(np.mean(np.abs(last_step) > _LOST_M))
        if lost > _MOST_LOST:
            share = f"{100 * lost:.0f} % of the mesh"
            raise EmptySurface(f"the shape of this pose has no surface within {100 * _FARTHEST_M:g} cm of {share}")
        # Points that found nothing, or something else than all around them, go along with their neighbours. Trust fades
        # gradually: a point that is believed in one frame and not in the next would jump.
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
        """Return where each point's search ended by itself, [C], metres along its normal, and how long its last step was, [C].

        Newton's method with the slope at rest, then secants.
        """
        way = np.zeros(len(self.points), dtype=np.float32)
        last_step = np.zeros_like(way)
        left = np.arange(len(way))  # points still on their way
        slope = self.slope
        before = last = None
        for _ in range(_STEPS):
            value = self.logits(pose, left, way[left])
            if last is not None:
                # The slope of the last step, within a factor of the one at rest.
                moved = way[left] - before
                secant = np.divide(value - last, moved, out=slope.copy(), where=moved != 0)
                slope = np.clip(secant, 3 * self.slope[left], self.slope[left] / 3)
            before, last = way[left], value
            step = np.clip(-value / slope, -_LONGEST_STEP_M, _LONGEST_STEP_M)
            way[left] = np.clip(before + step, -_FARTHEST_M, _FARTHEST_M)
            last_step[left] = step
            going = np.abs(step) > _REACHED_M
            left, before, last, slope = (values[going] for values in (left, before, last, slope))
            if len(left) <= _FEWEST * len(way):
                break
        return way, last_step


def _neighbours(mesh: Mesh) -> csr_matrix:
    """Return the matrix [V, V] that takes the mean of each vertex' neighbours."""
    from scipy.sparse import coo_matrix, diags

    start, end = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    count = len(mesh.vertices)
    ones = np.ones(2 * len(start), dtype=np.float32)
    joined = coo_matrix((ones, (np.concatenate([start, end]), np.concatenate([end, start]))), shape=(count, count)).tocsr()
    joined.data[:] = 1
    return (diags(1 / np.maximum(np.asarray(joined.sum(axis=1)).ravel(), 1)) @ joined).tocsr().astype(np.float32)


def _settled(avatar: TrainedField, pose: Tensor, mesh: Mesh) -> Mesh:
    """Return a canonical mesh with its vertices on the level set of the shape in `pose`, with weights and normals."""
    mesh = mesh.with_normals()
    way, last_step = Followed(avatar, pose, mesh).nearest_ways(pose)
    way = np.where(np.abs(last_step) > _LOST_M, 0, way)
    vertices = mesh.vertices + way[:, None] * mesh.normals
    weights = in_chunks(avatar.skinning_weights, vertices)
    return replace(mesh, vertices=vertices, weights=weights, normals=None).with_normals()


def _nearest_points(vertices: NDArray[np.float32], mesh: Mesh) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the corners [V, 3] of the triangle nearest to each point [V, 3], and their shares [V, 3] in its nearest point."""
    import igl

    corners = mesh.vertices.astype(np.float64)
    _, face, nearest = igl.point_mesh_squared_distance(vertices.astype(np.float64), corners, mesh.faces.astype(np.int64))
    index = mesh.faces[np.asarray(face).ravel()]
    a, b, c = (np.ascontiguousarray(corners[index[:, k]]) for k in range(3))
    shares = igl.barycentric_coordinates(np.ascontiguousarray(nearest), a, b, c)
    return index, np.asarray(shares, dtype=np.float32)
