"""The surface of a character: the skinned surface of an avatar, with a limited number of triangles."""

from __future__ import annotations

import logging

from torch import Tensor

from snarfcli.errors import UserError
from snarfcli.export.character import CharacterOptions
from snarfcli.export.decimate import decimate
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.skinned import SkinnedSurface, skinned_surface
from snarfcli.models.trained_field import TrainedField

__all__ = ["character_surface", "check_avatar"]

log = logging.getLogger(__name__)


def check_avatar(avatar: TrainedField) -> None:
    """Check that an avatar can be rigged.

    Raises:
        UserError: it has no skinning weights.
    """
    if not avatar.has_skinning_weights:
        raise UserError(
            f"a rig needs skinning weights of canonical points, which model {avatar.config.model.name} does not have; "
            'take an avatar of model=fast_snarf, or write single meshes with "snarf animate"'
        )


def character_surface(avatar: TrainedField, options: CharacterOptions) -> SkinnedSurface:
    """Return the skinned surface of an avatar with at most `options.triangles` triangles.

    Raises:
        UserError: the avatar has no skinning weights or no surface, or the surface needs more triangles.
    """
    check_avatar(avatar)
    try:
        surface = skinned_surface(avatar, options.resolution)
        if options.triangles is not None and len(surface.mesh.faces) > options.triangles:
            log.info("decimating %d triangles to %d", len(surface.mesh.faces), options.triangles)
            surface = SkinnedSurface(avatar, options.resolution, mesh=_decimated(surface.mesh, options.triangles))
        return _FixedSurface(surface) if avatar.config.condition.name == "none" else surface
    except (EmptySurface, FullSurface) as error:
        raise UserError(f"this avatar has no surface to export: {error}; train it longer, or give another by ckpt=") from None


class _FixedSurface(SkinnedSurface):
    """The surface of a shape that does not depend on the pose: its level set is searched for in the first pose only."""

    def __init__(self, surface: SkinnedSurface) -> None:
        vars(self).update(vars(surface))
        self._shape: Tensor | None = None

    def shape_in(self, pose: Tensor) -> Tensor:
        if self._shape is None:
            self._shape = super().shape_in(pose)
        return self._shape


def _decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with at most `triangles` triangles; too few are a user error."""
    try:
        return decimate(mesh, triangles)
    except ValueError as error:
        raise UserError(str(error)) from None
