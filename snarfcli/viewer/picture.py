"""What can be chosen about the picture, and what is to be seen at one moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.meshing.mesh import Mesh
from snarfcli.viewer.body import Posed

__all__ = ["RESOLUTIONS", "SURFACE_NAMES", "Picture", "ShownMesh", "ViewerLook"]

RESOLUTIONS = (48, 64, 96, 128, 192, 256, 384, 512)
SURFACE_NAMES = ("skinned", "field")


@dataclass(frozen=True)
class ViewerLook:
    """How the avatar is shown."""

    surface: str = "skinned"
    """skinned (the canonical mesh moved by its skin) or field (the union of all correspondences)."""
    skinned_resolution: int = 128
    """Voxels along the longest side of the canonical box."""
    field_resolution: int = 128
    """Voxels along the longest side of the posed box."""
    has_pose_shape: bool = True
    """Whether the skinned surface takes the shape of the pose, or keeps that of the canonical pose."""
    weight_colors: bool = False
    """Whether vertices are coloured by their skinning weights."""
    shows_canonical: bool = False
    """Whether the canonical shape stands beside the posed one."""
    shows_skeleton: bool = False
    """Whether joints and bones are drawn."""
    is_in_place: bool = False
    """Whether the body stays over one spot while it moves."""


@dataclass(frozen=True, eq=False)
class ShownMesh:
    """The surface that is to be seen."""

    surface: str
    """Which kind it is: skinned or field."""
    posed: Posed
    """The pose that it is in, which may be an earlier one than is wanted."""
    vertices: NDArray[np.float32]
    """[V, 3] metres."""
    faces: NDArray[np.int32]
    """[F, 3]; the very same array as long as the triangles stay the same."""
    weights: NDArray[np.float32] | None
    """[V, J], where colours are wanted and there are weights."""
    seconds: float | None
    """How long it, or the shape of its pose, took to make; None for what is made at once."""


@dataclass(frozen=True, eq=False)
class Picture:
    """All that is to be seen at one moment."""

    look: ViewerLook
    """How it is to be shown: the look that the rest was made for, while the one that is wanted may have changed since."""
    floor_y: float
    """Height of the floor, metres."""
    posed: Posed
    """The pose that is wanted."""
    mesh: ShownMesh | None
    """The surface; None while there is none."""
    canonical: Mesh | None
    """The canonical shape, if it is to be shown."""
    frame: int
    """Number of the frame of the motion."""
    is_playing: bool
    is_computing: bool
    """Whether the surface that is wanted is still being made."""
    message: str | None
    """What went wrong, in one line; None if nothing did."""

    @property
    def shown(self) -> Posed:
        """The pose that is seen."""
        return self.posed if self.mesh is None else self.mesh.posed
