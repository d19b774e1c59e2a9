"""Surfaces of an avatar: of its posed field and of its canonical shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from snarfcli.meshing.extract import extract_surface
from snarfcli.meshing.mesh import Mesh, vertex_normals
from snarfcli.models.trained_field import TrainedField

__all__ = [
    "canonical_surface",
    "check_posed",
    "field_surface",
    "in_chunks",
    "limited",
]

# Logits are clamped to this magnitude: larger ones mean only occupied or not, but would pull vertices onto lattice nodes. A
# point without a correspondence has a very negative one.
_LARGEST_LOGIT = 10.0
_NEIGHBOURS = 8  # candidates for the nearest vertex that faces the same way
_LEAF_SIZE = 16  # decides between vertices at the same distance
# Width, in cells, of the extra layer around the surface that is split. Bodies are of one piece: without such a layer, 40 meshes
# of two avatars were the same, with 12 % fewer evaluations.
_DILATE = 0


@torch.no_grad()
def field_surface(
    avatar: TrainedField,
    pose: Tensor,
    translation: Tensor | None = None,
    resolution: int = 256,
    *,
    weights_from: Mesh | None = None,
    keep_share: float = 0.01,
    chunk: int | None = None,
    transforms: Tensor | None = None,
) -> Mesh:
    """Extract the surface of the posed occupancy: the union over all correspondences, watertight (S Eq. 9).

    Args:
        avatar: gives the field.
        pose: [J, 3] axis-angle, radians, global orientation included.
        translation: [3], metres.
        resolution: number of cells along the longest side of the posed box.
        weights_from: canonical mesh with weights (`canonical_surface`); each vertex then gets the weights of the nearest
            vertex of this mesh in the same pose that faces the same way.
        keep_share: see `extract_surface`.
        chunk: maximum number of points per query; see `extract_surface`.
        transforms: [J, 4, 4], canonical to posed, metres, instead of those of the pose; for joints that stretch.

    Raises:
        EmptySurface, FullSurface: the field has no surface.
    """
    pose, transforms = check_posed(avatar, pose, translation, transforms)
    pose, transforms = pose.to(avatar.device), transforms.to(avatar.device)

    def posed_logits(points: Tensor) -> Tensor:
        return avatar.query(points[None], transforms[None], pose[None]).logits[0]

    mesh = _extract(avatar, posed_logits, avatar.posed_box(transforms), resolution, keep_share, chunk)
    return mesh if weights_from is None else replace(mesh, weights=_borrow_weights(avatar, transforms, mesh, weights_from))


@torch.no_grad()
def canonical_surface(
    avatar: TrainedField,
    pose: Tensor,
    resolution: int = 128,
    *,
    keep_share: float = 0.01,
    chunk: int | None = None,
) -> Mesh:
    """Extract the canonical surface under the condition of `pose` [J, 3], with exact skinning weights; see `field_surface`.

    Raises:
        EmptySurface, FullSurface: the field has no surface.
        ValueError: the avatar has no skinning weights.
    """
    pose = pose.to(avatar.device)

    def canonical_logits(points_c: Tensor) -> Tensor:
        return avatar.canonical_logits(points_c, pose)

    mesh = _extract(avatar, canonical_logits, avatar.canonical_box(), resolution, keep_share, chunk)
    return replace(mesh, weights=in_chunks(avatar.skinning_weights, mesh.vertices))


def _extract(
    avatar: TrainedField,
    logits: Callable[[Tensor], Tensor],
    box: tuple[Tensor, Tensor],
    resolution: int,
    keep_share: float,
    chunk: int | None,
) -> Mesh:
    """Extract the surface of logits in a box (lower [3], upper [3]) on the avatar's device."""
    return extract_surface(
        lambda points: limited(logits(points)),
        *box,
        resolution,
        dilate=_DILATE,
        widen=True,
        keep_share=keep_share,
        chunk=chunk,
        device=avatar.device,
    )


def check_posed(
    avatar: TrainedField, pose: Tensor, translation: Tensor | None, transforms: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the pose [J, 3] as float32 and its bone transforms [J, 4, 4].

    Raises:
        ValueError: an argument has a wrong shape.
    """
    if pose.ndim != 2 or pose.shape[1] != 3:
        raise ValueError(f"pose: wanted shape [J, 3], got {list(pose.shape)}")
    if translation is not None and translation.shape != (3,):
        raise ValueError(f"translation: wanted shape [3], got {list(translation.shape)}")
    pose = pose.float()
    if transforms is not None:
        if transforms.shape != (len(pose), 4, 4):
            raise ValueError(f"transforms: wanted shape [{len(pose)}, 4, 4], got {list(transforms.shape)}")
        return pose, transforms.float()
    translation = None if translation is None else translation.float()[None]
    return pose, avatar.bone_transforms(pose[None], translation)[0]


def limited(logits: Tensor) -> Tensor:
    """Return logits clamped to the range that matters near a surface."""
    return logits.clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT)


def in_chunks(function: Callable[[Tensor], Tensor], points: np.ndarray, chunk: int = 65536) -> np.ndarray:
    """Return `function` of `points` [N, 3] as float32, computed in parts of at most `chunk` points."""
    parts = [function(part).cpu() for part in torch.from_numpy(points).split(chunk)]
    return torch.cat(parts).float().numpy()


def _borrow_weights(avatar: TrainedField, transforms: Tensor, mesh: Mesh, mesh_c: Mesh) -> np.ndarray:
    """Return the weights [V, J] of the nearest vertex of `mesh_c`, posed, that faces the same way."""
    if mesh_c.weights is None:
        raise ValueError("weights_from: wanted a mesh with weights, got one without")
    vertices = in_chunks(lambda points_c: avatar.skin(points_c, transforms), mesh_c.vertices)
    count = min(_NEIGHBOURS, len(vertices))
    # A hand on a hip is also near the vertices of the hip, but those face the other way.
    nearest = np.reshape(KDTree(vertices, leafsize=_LEAF_SIZE).query(mesh.vertices, k=count)[1], (len(mesh.vertices), count))
    facing = np.einsum("vk,vnk->vn", mesh.unit_normals, vertex_normals(vertices, mesh_c.faces)[nearest]) > 0
    choice = np.where(facing.any(axis=1), facing.argmax(axis=1), 0)
    return mesh_c.weights[nearest[np.arange(len(nearest)), choice]]
