"""The surfaces of an avatar as the viewer asks for them: those that are made at once, and those that take a while."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.meshing.surfaces import field_surface

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
    """One pose of the avatar."""

    number: int
    """Grows with every change, so that two poses of the same number are the same."""
    pose: NDArray[np.float64]
    """[J, 3] axis-angle, radians, global orientation included."""
    translation: NDArray[np.float64]
    """[3] metres."""
    transforms: Floats
    """[J, 4, 4] canonical to posed, metres."""


@dataclass(frozen=True, eq=False)
class CanonicalRequest:
    """Ask for the canonical surface."""

    resolution: int
    """Voxels along the longest side of the canonical box."""


@dataclass(frozen=True, eq=False)
class CanonicalResult:
    """The canonical surface, which every pose is made from."""

    resolution: int
    surface: SkinnedSurface
    seconds: float


@dataclass(frozen=True, eq=False)
class ShapeRequest:
    """Ask how the canonical shape is in one pose."""

    posed: Posed
    canonical: CanonicalResult


@dataclass(frozen=True, eq=False)
class ShapeResult:
    """The canonical shape in one pose."""

    posed: Posed
    canonical: CanonicalResult
    vertices_c: Floats
    """[V, 3] canonical, metres."""
    seconds: float


@dataclass(frozen=True, eq=False)
class FieldRequest:
    """Ask for the surface of the field in one pose."""

    posed: Posed
    resolution: int
    """Voxels along the longest side of the posed box."""
    weights_from: Mesh | None
    """Canonical mesh that lends its weights; None where no weights are wanted."""


@dataclass(frozen=True, eq=False)
class FieldResult:
    """The surface of the field in one pose."""

    posed: Posed
    resolution: int
    mesh: Mesh
    seconds: float


class ViewerBody:
    """An avatar, asked for surfaces.

    Args:
        avatar: gives the field, the weights and the skeleton.
    """

    def __init__(self, avatar: Any) -> None:
        self.avatar = avatar
        self.skeleton = avatar.skeleton
        self.has_weights: bool = avatar.has_skinning_weights

    def transforms(self, pose: NDArray[np.float64], translation: NDArray[np.float64]) -> Floats:
        """Return the bone transforms [J, 4, 4], canonical to posed, of a pose [J, 3] and a translation [3]."""
        pose_t = torch.from_numpy(pose).float()[None]
        return self.avatar.bone_transforms(pose_t, torch.from_numpy(translation).float()[None])[0].cpu().numpy()

    def make(self, request: CanonicalRequest | ShapeRequest | FieldRequest) -> CanonicalResult | ShapeResult | FieldResult:
        """Make what was asked for, which may take seconds.

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
