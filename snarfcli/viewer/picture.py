"""The look chosen by the user, and the picture shown at one moment."""

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
    """skinned (the canonical mesh moved by linear blend skinning) or field (the union of all correspondences)."""
    skinned_resolution: int = 128
    """Voxels along the longest side of the canonical box."""
    field_resolution: int = 128
    """Voxels along the longest side of the posed box."""
    has_pose_shape: bool = True
    """Whether the skinned surface has the shape of the pose, or that of the canonical pose."""
    weight_colors: bool = False
    """Whether vertices are coloured by their skinning weights."""
    shows_canonical: bool = False
    """Whether the canonical shape is shown beside the posed one."""
    shows_skeleton: bool = False
    """Whether joints and bones are drawn."""
    is_in_place: bool = False
    """Whether the body moves in place, without horizontal translation."""


@dataclass(frozen=True, eq=False)
class ShownMesh:
    """The surface to show."""

    surface: str
    """Kind of surface: skinned or field."""
    posed: Posed
    """Its pose, which may be an earlier one than the current pose."""
    vertices: NDArray[np.float32]
    """[V, 3] metres."""
    faces: NDArray[np.int32]
    """[F, 3]; the same array object while the triangles are the same."""
    weights: NDArray[np.float32] | None
    """[V, J] for colours; None without colours or weights."""
    seconds: float | None
    """Time to compute it, or the shape of its pose; None if neither was computed."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Everything shown at one moment."""

    look: ViewerLook
    """The look of this picture; the current look may have changed since."""
    floor_y: float
    """Height of the floor, metres."""
    posed: Posed
    """The current pose."""
    mesh: ShownMesh | None
    """The surface; None until there is one."""
    canonical: Mesh | None
    """The canonical shape, if it is shown."""
    frame: int
    """Number of the frame of the motion."""
    is_playing: bool
    is_computing: bool
    """Whether the surface of the current pose and look is still being computed."""
    message: str | None
    """The latest error in one line; None if there is none."""

    @property
    def shown(self) -> Posed:
        """The pose of the shown surface."""
        return self.posed if self.mesh is None else self.mesh.posed
