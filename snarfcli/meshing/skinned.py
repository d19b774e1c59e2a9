"""The skinned surface: one canonical mesh that follows the pose-dependent shape and is moved by linear blend skinning."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from snarfcli.deformer.skinning import skin
from snarfcli.meshing.followed import Followed
from snarfcli.meshing.mesh import Mesh, normals_at_vertices
from snarfcli.meshing.surfaces import canonical_surface, check_posed, in_chunks
from snarfcli.models.trained_field import TrainedField

__all__ = ["SkinnedSurface", "skinned_surface"]

# The pose-dependent motion of the shape is computed at the vertices of a coarser mesh, 2 cm apart on a body, and interpolated.
# Compared with computing it at every vertex at resolution 256, the mean error is 0.2 to 0.4 mm (benchmarks/bm_surfaces.py).
_CONTROL_RESOLUTION = 96


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
        self._vertices, self._normals, self._weights, self._faces = (
            torch.tensor(array, device=avatar.device)
            for array in (fine.vertices, fine.unit_normals, fine.skinning_weights, fine.faces.astype(np.int64))
        )
        coarse = None
        if mesh is not None or resolution > _CONTROL_RESOLUTION:
            coarse = _settled(avatar, rest, canonical_surface(avatar, rest, _CONTROL_RESOLUTION, keep_share=keep_share))
        if coarse is None or len(coarse.vertices) >= len(fine.vertices):
            self.control, self._spread = Followed(avatar, rest, fine), None
        else:
            nearest = _nearest_points(fine.vertices, coarse)
            self.control = Followed(avatar, rest, coarse)
            self._spread = tuple(torch.from_numpy(array).to(avatar.device) for array in nearest)

    def canonical_vertices(self, pose: Tensor) -> NDArray[np.float32]:
        """Return the vertices [V, 3], canonical frame, metres, on the level set of the shape in `pose` [J, 3].

        Raises:
            EmptySurface: in this pose the shape has no surface near most of the vertices.
        """
        return self.shape_in(pose).cpu().numpy()

    @torch.no_grad()
    def shape_in(self, pose: Tensor) -> Tensor:
        """Return `canonical_vertices` on the avatar's device."""
        return self._vertices + self.spread(self.control.ways(pose.float()))[:, None] * self._normals

    def spread(self, way: Tensor) -> Tensor:
        """Return the ways of the vertices [V], interpolated from those of the control points [C], metres along the normals."""
        if self._spread is None:
            return way
        corners, shares = self._spread
        return (way[corners] * shares).sum(1)

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
        vertices = skin(self.shape_in(pose), self._weights, transforms.to(self._weights.device))
        normals = normals_at_vertices(vertices, self._faces)
        return replace(self.mesh, vertices=vertices.cpu().numpy(), normals=normals.cpu().numpy())


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


def _settled(avatar: TrainedField, pose: Tensor, mesh: Mesh) -> Mesh:
    """Return a canonical mesh with its vertices on the level set of the shape in `pose`, with weights and normals."""
    vertices = Followed(avatar, pose, mesh.with_normals()).settled(pose).cpu().numpy()
    weights = in_chunks(avatar.skinning_weights, vertices)
    return replace(mesh, vertices=vertices, weights=weights, normals=None).with_normals()


def _nearest_points(vertices: NDArray[np.float32], mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the corners [V, 3] of the triangle nearest to each vertex, and their shares [V, 3] in the nearest point."""
    corners = mesh.vertices.astype(np.float64)
    _, face, nearest = igl.point_mesh_squared_distance(vertices.astype(np.float64), corners, mesh.faces.astype(np.int64))
    index = mesh.faces[np.asarray(face).ravel()].astype(np.int64)
    a, b, c = (np.ascontiguousarray(corners[index[:, k]]) for k in range(3))
    shares = igl.barycentric_coordinates(np.ascontiguousarray(nearest), a, b, c)
    return index, np.asarray(shares, dtype=np.float32)
