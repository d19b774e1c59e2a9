"""Cache of computed surfaces; decides which to compute next and which to show."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.texts import one_line
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

_BELOW_JOINTS = 0.03  # distance of the sole below the joints of the foot, share of the size of the body
_POINTS = 3000  # vertices of a body, enough to find the lowest one

_Request = CanonicalRequest | ShapeRequest | FieldRequest
_Result = CanonicalResult | ShapeResult | FieldResult


class SurfaceCache:
    """The latest surface of each kind, and errors of surfaces that could not be computed.

    Args:
        body: body of the surfaces. They are computed elsewhere, since that is slow.
    """

    def __init__(self, body: ViewerBody) -> None:
        self._body = body
        self._canonical: CanonicalResult | None = None
        self._shape: ShapeResult | None = None
        self._field: FieldResult | None = None
        self._latest: type | None = None  # kind of the latest request
        self._failed: dict[tuple, str] = {}  # requests that failed, and why

    def store(self, request: _Request, result: _Result | None, error: BaseException | None) -> bool:
        """Store the result of a request, or its error; return whether it is the first canonical surface."""
        is_first, self._latest = False, type(request)
        if error is not None:
            if not isinstance(error, EmptySurface | FullSurface):
                log.error("the viewer continues after: %s: %s", type(error).__name__, one_line(error, 300), exc_info=error)
            self._failed[_key(request)] = one_line(error, 300)
        elif isinstance(result, CanonicalResult):
            is_first, self._canonical = self._canonical is None, result
        elif isinstance(result, ShapeResult):
            self._shape = result
        else:
            self._field = result
        return is_first

    def wanted(self, posed: Posed, look: ViewerLook) -> list[_Request]:
        """Return the requests for a pose and a look, the most urgent first; empty if all are stored or have failed."""
        requests: list[_Request] = []
        canonical = self._canonical
        if canonical is not None and canonical.resolution != look.skinned_resolution:
            canonical = None
        if self._body.has_weights and canonical is None:
            requests.append(CanonicalRequest(look.skinned_resolution))
        if look.surface == "field" and not self._is_current(posed, look):
            lender = self._canonical.surface.mesh if look.weight_colors and self._canonical else None
            requests.append(FieldRequest(posed, look.field_resolution, lender))
        if canonical is not None and look.has_pose_shape and (look.surface == "skinned" or look.shows_canonical):
            shape = self._shape
            if shape is None or shape.canonical is not canonical or shape.posed.number != posed.number:
                requests.append(ShapeRequest(posed, canonical))
        if self._latest is FieldRequest:  # field and shape alternate, or a playing motion would starve the shape
            requests.sort(key=lambda request: isinstance(request, FieldRequest))
        # A failed request is not repeated for the same pose, and its error is not shown for another one.
        wanted = {_key(request) for request in requests}
        self._failed = {key: why for key, why in self._failed.items() if key in wanted}
        return [request for request in requests if _key(request) not in self._failed]

    @property
    def problem(self) -> str | None:
        """Why a requested surface could not be computed; None if there is no error."""
        return next(iter(self._failed.values()), None)

    def shown(self, posed: Posed, look: ViewerLook, is_playing: bool) -> ShownMesh | None:
        """Return the requested surface, or the best one until it is computed; None if there is none."""
        field, canonical = self._field, self._canonical
        # A surface of an earlier pose is better than none, and while playing better than the other kind.
        is_good = is_playing or canonical is None or self._is_current(posed, look)
        if look.surface == "field" and field is not None and is_good:
            weights = field.mesh.weights if look.weight_colors else None
            return ShownMesh("field", field.posed, field.mesh.vertices, field.mesh.faces, weights, field.seconds)
        if canonical is None:
            return None
        mesh_c, shape = canonical.surface.mesh, self._pose_shape(canonical, look)
        assert mesh_c.weights is not None
        vertices = skin_vertices(_vertices_c(canonical, shape), mesh_c.weights, posed.transforms)
        weights = mesh_c.weights if look.weight_colors else None
        return ShownMesh("skinned", posed, vertices, mesh_c.faces, weights, shape.seconds if shape else None)

    def canonical(self, look: ViewerLook) -> Mesh | None:
        """Return the canonical mesh, in the shape of the latest pose whose shape is known; None until there is one."""
        canonical = self._canonical
        if canonical is None:
            return None
        vertices = _vertices_c(canonical, self._pose_shape(canonical, look))
        return replace(canonical.surface.mesh, vertices=vertices, normals=None)

    def lowest(self, transforms: NDArray[np.float32]) -> float:
        """Return the height of the lowest point of the body, metres; approximate while only its joints are known."""
        if self._canonical is not None:
            mesh_c = self._canonical.surface.mesh
            assert mesh_c.weights is not None
            some = slice(None, None, max(len(mesh_c.vertices) // _POINTS, 1))
            return float(skin_vertices(mesh_c.vertices[some], mesh_c.weights[some], transforms)[:, 1].min())
        joints = posed_joints(self._body.skeleton, transforms)
        return float(joints[:, 1].min() - _BELOW_JOINTS * np.ptp(joints, axis=0).max())

    def _pose_shape(self, canonical: CanonicalResult, look: ViewerLook) -> ShapeResult | None:
        """Return the latest shape of a pose, if the look shows it and it belongs to the canonical surface."""
        shape = self._shape
        return shape if look.has_pose_shape and shape is not None and shape.canonical is canonical else None

    def _is_current(self, posed: Posed, look: ViewerLook) -> bool:
        """Return whether the field surface is that of the pose and the look."""
        field = self._field
        return (
            field is not None
            and field.posed.number == posed.number
            and field.resolution == look.field_resolution
            and (field.mesh.weights is not None or not (look.weight_colors and self._canonical))
        )


def _vertices_c(canonical: CanonicalResult, shape: ShapeResult | None) -> NDArray[np.float32]:
    """Return the canonical vertices [V, 3], metres, in a shape if there is one."""
    return canonical.surface.mesh.vertices if shape is None else shape.vertices_c


def _key(request: _Request) -> tuple:
    """Return what identifies a request: its kind, the number of its pose and the resolution."""
    if isinstance(request, CanonicalRequest):
        return "canonical", None, request.resolution
    if isinstance(request, ShapeRequest):
        return "shape", request.posed.number, request.canonical.resolution
    return "field", request.posed.number, request.resolution
