"""Requests for surfaces of an avatar, and their results."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.meshing.surfaces import field_surface
from snarfcli.models.trained_field import TrainedField

__all__ = [
    "CanonicalRequest",
    "CanonicalResult",
    "FieldRequest",
    "FieldResult",
    "Posed",
    "ShapeRequest",
    "ShapeResult",
    "ViewerBody",
]

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Posed:
    """A pose of the avatar."""

    number: int
    """Counts changes of the pose; equal numbers mean equal poses."""
    pose: NDArray[np.float64]
    """[J, 3] axis-angle, radians, global orientation included."""
    translation: NDArray[np.float64]
    """[3] metres."""
    transforms: Floats
    """[J, 4, 4] canonical to posed, metres."""


@dataclass(frozen=True, eq=False)
class CanonicalRequest:
    """A request for the canonical surface."""

    resolution: int
    """Voxels along the longest side of the canonical box."""


@dataclass(frozen=True, eq=False)
class CanonicalResult:
    """The canonical surface, from which all skinned surfaces are computed."""

    resolution: int
    surface: SkinnedSurface
    seconds: float
    """Time that it took to compute."""


@dataclass(frozen=True, eq=False)
class ShapeRequest:
    """A request for the canonical shape of a pose."""

    posed: Posed
    canonical: CanonicalResult


@dataclass(frozen=True, eq=False)
class ShapeResult:
    """The canonical shape of a pose."""

    posed: Posed
    canonical: CanonicalResult
    vertices_c: Floats
    """[V, 3] canonical, metres."""
    seconds: float


@dataclass(frozen=True, eq=False)
class FieldRequest:
    """A request for the field surface of a pose."""

    posed: Posed
    resolution: int
    """Voxels along the longest side of the posed box."""
    weights_from: Mesh | None
    """Canonical mesh from which weights are copied; None for a surface without weights."""


@dataclass(frozen=True, eq=False)
class FieldResult:
    """The field surface of a pose."""

    posed: Posed
    resolution: int
    mesh: Mesh
    seconds: float


class ViewerBody:
    """Computes the surfaces of an avatar.

    Args:
        avatar: gives the field, the weights and the skeleton.
    """

    def __init__(self, avatar: TrainedField) -> None:
        self.avatar = avatar
        self.skeleton = avatar.skeleton
        self.has_weights = avatar.has_skinning_weights

    def transforms(self, pose: NDArray[np.float64], translation: NDArray[np.float64]) -> Floats:
        """Return the bone transforms [J, 4, 4], canonical to posed, of a pose [J, 3] and a translation [3]."""
        pose_t = torch.from_numpy(pose).float()[None]
        return self.avatar.bone_transforms(pose_t, torch.from_numpy(translation).float()[None])[0].cpu().numpy()

    def make(self, request: CanonicalRequest | ShapeRequest | FieldRequest) -> CanonicalResult | ShapeResult | FieldResult:
        """Compute the result of a request, which may take seconds.

        Raises:
            EmptySurface, FullSurface: there is no surface in this pose.
        """
        start = time.perf_counter()
        if isinstance(request, CanonicalRequest):
            surface = SkinnedSurface(self.avatar, request.resolution)
            return CanonicalResult(request.resolution, surface, time.perf_counter() - start)
        pose = torch.from_numpy(request.posed.pose).float()
        if isinstance(request, ShapeRequest):
            vertices_c = request.canonical.surface.canonical_vertices(pose)
            return ShapeResult(request.posed, request.canonical, vertices_c, time.perf_counter() - start)
        mesh = field_surface(
            self.avatar,
            pose,
            resolution=request.resolution,
            weights_from=request.weights_from,
            transforms=torch.from_numpy(request.posed.transforms),
        )
        return FieldResult(request.posed, request.resolution, mesh, time.perf_counter() - start)
