"""The mesh of an avatar in one pose, of either kind of surface."""

from __future__ import annotations

from torch import Tensor

from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import skinned_surface
from snarfcli.meshing.surfaces import field_surface
from snarfcli.models.trained_field import TrainedField

__all__ = ["SURFACES", "posed_mesh"]

SURFACES = ("field", "skinned")
"""Kinds of surfaces: that of the posed field, and the canonical mesh moved by linear blend skinning."""


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
    """Return the surface of the kind `surface`, see `SURFACES`; `weights_from` serves `field` only.

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
