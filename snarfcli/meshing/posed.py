"""The mesh of an avatar in one pose, for both kinds of surfaces."""

from __future__ import annotations

from torch import Tensor

from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import skinned_surface
from snarfcli.meshing.surfaces import field_surface
from snarfcli.models.trained_field import TrainedField

__all__ = ["RESOLUTIONS", "SURFACES", "posed_mesh"]

SURFACES = ("field", "skinned")
"""Kinds of surfaces: the surface of the posed field, and the canonical mesh moved by linear blend skinning."""
RESOLUTIONS = (16, 1024)
"""Range of voxels along the longest side. Lattices are dense: 1024 takes about 3 GB for a body with spread arms."""


def posed_mesh(
    avatar: TrainedField,
    pose: Tensor,
    translation: Tensor | None = None,
    resolution: int = 256,
    *,
    surface: str = "field",
    weights_from: Mesh | None = None,
    keep_share: float = 0.01,
    transforms: Tensor | None = None,
) -> Mesh:
    """Return the surface of kind `surface` in one pose; see `field_surface` for the arguments.

    Args:
        avatar: gives the field.
        pose: [J, 3] axis-angle, radians, global orientation included.
        translation: [3], metres.
        resolution: voxels along the longest side.
        surface: one of `SURFACES`.
        weights_from: canonical mesh with weights, for `field` only.
        keep_share: see `extract_surface`.
        transforms: [J, 4, 4], canonical to posed, metres, instead of those of the pose.

    Raises:
        ValueError: `surface` is unknown.
        EmptySurface, FullSurface: the field has no surface.
    """
    if surface == "field":
        return field_surface(
            avatar, pose, translation, resolution, weights_from=weights_from, keep_share=keep_share, transforms=transforms
        )
    if surface == "skinned":
        return skinned_surface(avatar, resolution, keep_share).posed(pose, translation, transforms)
    raise ValueError(f"surface: wanted one of {', '.join(SURFACES)}, got {surface!r}")
