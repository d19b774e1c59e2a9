"""Light on a mesh, by ray casting: a dome, a key light and their soft shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from snarfcli.meshing.mesh import Mesh, vertex_normals
from snarfcli.rendering.camera import Camera
from snarfcli.sampling.rays import NO_HIT, FirstHits, ray_mesh

__all__ = ["PATTERN", "LitScene", "Look", "Solid", "dot"]

PATTERN = 3
"""Width in pixels of a pattern of ray directions; a blur of this width averages it."""
_REACH = 0.8  # metres at which a surface no longer darkens another


@dataclass(frozen=True)
class Look:
    """Colours (linear RGB) and lights of a picture."""

    body: tuple[float, float, float] = (0.36, 0.47, 0.60)
    """Albedo of a mesh without colours."""
    floor: tuple[float, float, float] = (0.68, 0.69, 0.70)
    """Colour of the lit floor."""
    backdrop: tuple[float, float, float] = (0.74, 0.76, 0.785)
    """Colour to which the floor fades."""
    key: tuple[float, float, float] = (1.40, 1.30, 1.15)
    """Radiance of the key light, from the upper left of the camera."""
    sky: tuple[float, float, float] = (0.36, 0.41, 0.50)
    """Radiance of the dome overhead."""
    rim: tuple[float, float, float] = (0.55, 0.60, 0.70)
    """Radiance of the light from behind, on the right."""
    key_radius: float = 0.22
    """Radius of the key light over its distance; a larger one has softer shadows."""
    sky_rays: int = 8
    """Occlusion rays towards the dome, per pixel."""
    key_rays: int = 4
    """Shadow rays towards the key light, per pixel."""


class Solid:
    """A mesh prepared for rays, for any number of pictures."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.normals = vertex_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals
        # Coordinates near the origin, where the float32 of the rays is precise.
        self.origin = ((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2).astype(np.float32)
        self.rays = ray_mesh(mesh.vertices - self.origin, mesh.faces)

    def distances(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the length of each ray [N, 3] up to its first hit, metres; above `NO_HIT` if it hits nothing."""
        origins = np.ascontiguousarray(points - self.origin, dtype=np.float32)
        return self.rays.distances(origins, np.ascontiguousarray(directions, dtype=np.float32))

    def first_hits(self, eye: np.ndarray, directions: np.ndarray) -> FirstHits:
        """Return the first hits of rays [N, 3] from one point."""
        origins = np.broadcast_to((eye - self.origin).astype(np.float32), directions.shape)
        return self.rays.first_hits(np.ascontiguousarray(origins), np.ascontiguousarray(directions))


class LitScene:
    """A solid and the lights of one camera."""

    def __init__(self, solid: Solid, camera: Camera, floor_y: float, look: Look) -> None:
        self.solid = solid
        self.camera = camera
        self.floor_y = floor_y
        self.look = look
        self.key, self.rim = _lights(camera)

    def gather(
        self, points: np.ndarray, normals: np.ndarray, phase: np.ndarray, *, floor: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the light of the dome [M, 3] and the visible share of the key light [M].

        Args:
            points: [M, 3] on a surface.
            normals: [M, 3] unit length.
            phase: [M] from 0 to 8, rotation of the set of directions.
            floor: whether downward rays meet the floor.
        """
        look, count = self.look, len(points)
        points, normals = points.astype(np.float32), normals.astype(np.float32)
        start = points + np.float32(2e-3) * normals
        tangent, bitangent = _frames(normals)
        # Points of the disc lifted to the hemisphere have a cosine distribution.
        disc = _spiral(look.sky_rays)
        lifted = np.concatenate([disc, np.sqrt(np.maximum(1 - (disc**2).sum(axis=2, keepdims=True), 0))], axis=2)
        rays = (lifted[phase] @ np.stack([tangent, bitangent, normals], axis=1)).reshape(-1, 3)
        begin = start.repeat(look.sky_rays, axis=0)
        free = np.minimum(self.solid.distances(begin, rays) / _REACH, 1).reshape(count, -1)
        up = rays[:, 1].reshape(count, -1)
        share = np.float32(1 / look.sky_rays)
        # Each ray adds to the share of the sky, of the floor or of the body; the shares then weight the colours.
        from_sky = free * (np.float32(0.55) + np.float32(0.45) * up)
        from_floor = np.zeros(count, dtype=np.float32)
        if floor:
            # The floor reflects light, less of it below the body.
            near = np.clip((points[:, 1] - self.floor_y) / 0.35, 0.15, 1)
            from_floor = 0.30 * near * (free * (up < 0)).sum(axis=1) * share
            from_sky *= up >= 0
        # Without reflected light creases would be black.
        from_body = 0.12 * (1 - free).sum(axis=1) * share
        shares = np.stack([from_sky.sum(axis=1) * share, from_floor, from_body], axis=1)
        dome = shares @ np.array([look.sky, look.floor, look.body], dtype=np.float32)

        across = np.concatenate(_frames(self.key[None]))
        rays = (self.key + look.key_radius * _spiral(look.key_rays) @ across).astype(np.float32)[phase].reshape(-1, 3)
        clear = self.solid.distances(start.repeat(look.key_rays, axis=0), rays) > NO_HIT
        return dome, clear.reshape(count, look.key_rays).mean(axis=1)


def _lights(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions towards the key and the rim light; they turn with the camera, so that all views are lit well."""
    right = camera.axes[0]
    viewer = np.cross(right, (0.0, 1.0, 0.0))
    key = -0.80 * right + (0.0, 0.95, 0.0) + 0.55 * viewer
    rim = 0.75 * right + (0.0, 0.55, 0.0) - 0.8 * viewer
    return (key / np.linalg.norm(key)).astype(np.float32), (rim / np.linalg.norm(rim)).astype(np.float32)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products [M, 1] of vectors [M, 3]."""
    return np.einsum("mc,mc->m", a, b)[:, None]


def _spiral(count: int) -> np.ndarray:
    """Return `count` points on the unit disc per phase of the pattern, [phases, count, 2] float32.

    One Fibonacci spiral, dealt out to the phases in turn, so that neighbouring pixels sample different directions.
    """
    phases = PATTERN**2
    index = np.arange(count)[None] * phases + np.arange(phases)[:, None]
    radius = np.sqrt((index + 0.5) / (count * phases))
    angle = math.pi * (5**0.5 - 1) * index
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2).astype(np.float32)


def _frames(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors [M, 3] perpendicular to each normal (Duff et al., Building an Orthonormal Basis, JCGT 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1, -1).astype(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return (
        np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1),
        np.stack([b, sign + y * y * a, -y], axis=1),
    )
