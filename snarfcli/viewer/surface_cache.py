"""The surfaces that were made: which one comes next, and what is shown of those there are."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.viewer.body import (
    CanonicalRequest,
    CanonicalResult,
    FieldRequest,
    FieldResult,
    Posed,
    ShapeRequest,
    ShapeResult,
    ViewerBody,
)
from snarfcli.viewer.joints import posed_joints
from snarfcli.viewer.picture import ShownMesh, ViewerLook

__all__ = ["SurfaceCache"]

log = logging.getLogger(__name__)

_BELOW_JOINTS = 0.03  # of the body's size: how far the sole is below the joints of the foot
_POINTS = 3000  # of the body, enough to find its lowest one


class SurfaceCache:
    """The latest surface of each kind, and what could not be made.

    Args:
        body: who makes them; not here, since that takes long.
    """

    def __init__(self, body: ViewerBody) -> None:
        self._body = body
        self._canonical: CanonicalResult | None = None
        self._shape: ShapeResult | None = None
        self._field: FieldResult | None = None
        self._latest: type | None = None  # kind of what was done last
        self._failed: dict[tuple, str] = {}  # what could not be made, and why

    def keep(self, request: Any, made: Any, error: BaseException | None) -> bool:
        """Keep what was made, or why it was not; return whether it is the first canonical surface."""
        is_first, self._latest = False, type(request)
        if error is not None:
            if not isinstance(error, EmptySurface | FullSurface):
                log.error("the viewer goes on after: %s: %s", type(error).__name__, error, exc_info=error)
            self._failed[_key(request)] = str(error) or type(error).__name__
        elif isinstance(made, CanonicalResult):
            is_first, self._canonical = self._canonical is None, made
        elif isinstance(made, ShapeResult):
            self._shape = made
        else:
            self._field = made
        return is_first

    def wanted(self, posed: Posed, look: ViewerLook) -> list[CanonicalRequest | ShapeRequest | FieldRequest]:
        """Return what has to be made for a pose and a look, what is more urgent first; empty if all is there, or cannot be."""
        requests: list[CanonicalRequest | ShapeRequest | FieldRequest] = []
        has_canonical = self._canonical is not None and self._canonical.resolution == look.skinned_resolution
        if self._body.has_weights and not has_canonical:
            requests.append(CanonicalRequest(look.skinned_resolution))
        if look.surface == "field" and not self._is_current(posed, look):
            lender = self._canonical.surface.mesh if look.weight_colors and self._canonical else None
            requests.append(FieldRequest(posed, look.field_resolution, lender))
        if has_canonical and look.has_pose_shape and (look.surface == "skinned" or look.shows_canonical):
            made = self._shape
            if made is None or made.canonical is not self._canonical or made.posed.number != posed.number:
                requests.append(ShapeRequest(posed, self._canonical))
        if self._latest is FieldRequest:  # field and shape take turns, or a motion would never let the second one come
            requests.sort(key=lambda request: isinstance(request, FieldRequest))
        # What failed is not tried again for the same pose, nor spoken of for another one.
        wanted = {_key(request) for request in requests}
        self._failed = {key: why for key, why in self._failed.items() if key in wanted}
        return [request for request in requests if _key(request) not in self._failed]

    @property
    def problem(self) -> str | None:
        """Why something that is wanted cannot be made; None if there is no such thing."""
        return next(iter(self._failed.values()), None)

    def shown(self, posed: Posed, look: ViewerLook, is_playing: bool) -> ShownMesh | None:
        """Return the surface that is wanted, or the best one there is until it is made; None for none."""
        made, canonical, shape = self._field, self._canonical, self._shape
        # A surface of an earlier pose is better than none, and while playing better than the other kind.
        is_good = is_playing or canonical is None or self._is_current(posed, look)
        if look.surface == "field" and made is not None and is_good:
            weights = made.mesh.weights if look.weight_colors else None
            return ShownMesh("field", made.posed, made.mesh.vertices, made.mesh.faces, weights, made.seconds)
        if canonical is None:
            return None
        mesh_c = canonical.surface.mesh
        vertices = skin_vertices(self._vertices_c(look), mesh_c.weights, posed.transforms)
        has_shape = look.has_pose_shape and shape is not None and shape.canonical is canonical
        weights = mesh_c.weights if look.weight_colors else None
        return ShownMesh("skinned", posed, vertices, mesh_c.faces, weights, shape.seconds if has_shape else None)

    def canonical(self, look: ViewerLook) -> Mesh | None:
        """Return the canonical mesh, in the shape of the latest pose whose shape is known; None as long as there is none."""
        if self._canonical is None:
            return None
        return replace(self._canonical.surface.mesh, vertices=self._vertices_c(look), normals=None)

    def lowest(self, transforms: NDArray[np.float32]) -> float:
        """Return the height of the lowest point of the body, metres; about that as long as only its joints are known."""
        if self._canonical is not None:
            mesh_c = self._canonical.surface.mesh
            some = slice(None, None, max(len(mesh_c.vertices) // _POINTS, 1))
            return float(skin_vertices(mesh_c.vertices[some], mesh_c.weights[some], transforms)[:, 1].min())
        joints = posed_joints(self._body.skeleton, transforms)
        return float(joints[:, 1].min() - _BELOW_JOINTS * np.ptp(joints, axis=0).max())

    def _vertices_c(self, look: ViewerLook) -> NDArray[np.float32]:
        shape = self._shape
        if look.has_pose_shape and shape is not None and shape.canonical is self._canonical:
            return shape.vertices_c
        return self._canonical.surface.mesh.vertices

    def _is_current(self, posed: Posed, look: ViewerLook) -> bool:
        """Return whether the field's surface is the one that is wanted."""
        made = self._field
        return (
            made is not None
            and made.posed.number == posed.number
            and made.resolution == look.field_resolution
            and (made.mesh.weights is not None or not (look.weight_colors and self._canonical))
        )


def _key(request: CanonicalRequest | ShapeRequest | FieldRequest) -> tuple:
    """Return what a request is for: its kind, the pose it depends on and the resolution."""
    if isinstance(request, CanonicalRequest):
        return "canonical", None, request.resolution
    if isinstance(request, ShapeRequest):
        return "shape", request.posed.number, request.canonical.resolution
    return "field", request.posed.number, request.resolution
