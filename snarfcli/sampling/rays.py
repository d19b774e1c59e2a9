"""Rays against a triangle mesh: with Embree where it is installed, otherwise with libigl, a fifth as fast."""

from __future__ import annotations

import logging
from functools import cache
from typing import NamedTuple, Protocol

import igl
import numpy as np

from snarfcli.extras import why_not_imported

__all__ = ["NO_HIT", "FirstHits", "RayMesh", "count_crossings", "ray_mesh", "why_no_embree"]

log = logging.getLogger(__name__)

NO_HIT = 1e6
"""A distance above this says that a ray hits nothing, metres."""


class FirstHits(NamedTuple):
    """Where rays first meet a mesh."""

    triangle: np.ndarray
    """[N] index of the triangle, -1 for none."""
    u: np.ndarray
    """[N] float32, weight of its second corner."""
    v: np.ndarray
    """[N] float32, weight of its third corner."""


class RayMesh(Protocol):
    """A mesh that is prepared for rays; origins and directions are [N, 3] float32, directions of unit length."""

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the length of each ray up to its first hit, [N], metres; above `NO_HIT` if it hits nothing."""
        ...

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> FirstHits:
        """Return the first hit of each ray."""
        ...


@cache
def why_no_embree() -> str | None:
    """Return why Embree is not used, as one line; None if it is."""
    return why_not_imported("embreex", "embreex.mesh_construction", "embreex.rtcore_scene")


def ray_mesh(vertices: np.ndarray, faces: np.ndarray) -> RayMesh:
    """Return a mesh for rays. The log says it once if Embree is not used.

    Args:
        vertices: [V, 3], near the origin, where float32 is precise.
        faces: [F, 3], vertex indices.
    """
    reason = why_no_embree()
    if reason is None:
        return _EmbreeMesh(vertices, faces)
    _say(f"rays are traced by libigl, several times slower than by Embree, since {reason}")
    return _TreeMesh(vertices, faces)


def count_crossings(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return how often the ray from each point crosses the surface, [N].

    Args:
        vertices: [V, 3].
        faces: [F, 3], vertex indices.
        points: [N, 3].
        direction: [3] unit length, of all rays.
    """
    directions = np.broadcast_to(direction, points.shape)
    if why_no_embree() is None:
        import trimesh  # here: loading it takes a second, and winding numbers do not need it

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        rays = mesh.ray.intersects_id(points, directions, multiple_hits=True)[1]
        return np.bincount(rays, minlength=len(points))
    corners, triangles, tree = _tree(vertices, faces)
    hits = tree.intersect_ray(corners, triangles, np.ascontiguousarray(points, np.float64), np.ascontiguousarray(directions))
    return np.array([len(one) for one in hits], np.int64)


class _EmbreeMesh:
    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(self._scene, vertices, faces)

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return self._scene.run(origins, directions, query="DISTANCE")

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> FirstHits:
        found = self._scene.run(origins, directions, output=True)
        return FirstHits(found["primID"], found["u"], found["v"])


class _TreeMesh:
    """A tree of boxes by libigl, in float64."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._vertices, self._faces, self._tree = _tree(vertices, faces)

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        triangle, distance, _ = self._run(origins, directions)
        return np.where(triangle < 0, np.inf, distance).astype(np.float32)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> FirstHits:
        triangle, _, weights = self._run(origins, directions)
        u, v = np.where(triangle[:, None] < 0, 0, weights).astype(np.float32).T  # undefined where nothing is hit
        return FirstHits(triangle, u, v)

    def _run(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rays = (np.ascontiguousarray(origins, np.float64), np.ascontiguousarray(directions, np.float64))
        triangle, distance, weights = self._tree.intersect_ray_first(self._vertices, self._faces, *rays)
        return np.asarray(triangle), np.asarray(distance), np.asarray(weights)


def _tree(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, igl.AABB]:
    """Return a mesh as libigl takes it, and its tree of boxes."""
    corners, triangles = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    tree = igl.AABB()
    tree.init(corners, triangles)
    return corners, triangles, tree


@cache
def _say(line: str) -> None:
    """Write a line to the log, once per process."""
    log.info("%s", line)
