"""Nearest neighbours of points: the area that each stands for, and the plane through it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

__all__ = ["LEAST_POINTS", "find_neighbours", "plane_normals", "point_areas"]

Array = NDArray[np.float64]

LEAST_POINTS = 16
"""Minimum number of points of a cloud."""

_AREA_NEIGHBOURS = 8


def find_neighbours(points: Array, count: int) -> tuple[Array, NDArray[np.intp]]:
    """Return the distances [N, K] to the nearest other points [N, 3], nearest first, and their numbers [N, K].

    Raises:
        ValueError: there are fewer than `LEAST_POINTS` points, or one is not finite.
    """
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < LEAST_POINTS:
        raise ValueError(f"points: wanted [N, 3] with at least {LEAST_POINTS} points, got {list(points.shape)}")
    if not np.isfinite(points).all():
        raise ValueError("points: wanted finite numbers, got NaN or infinity")
    distances, numbers = KDTree(points).query(points, k=min(count + 1, len(points)))
    return np.asarray(distances)[:, 1:], np.asarray(numbers)[:, 1:]


def point_areas(points: Array) -> Array:
    """Return the area [N] that each point stands for, squared units: the share of a disk around it that holds K others."""
    distances, _ = find_neighbours(points, _AREA_NEIGHBOURS)
    return np.pi * np.square(distances[:, -1]) / (distances.shape[1] + 0.5)


def plane_normals(points: Array, neighbours: NDArray[np.intp]) -> Array:
    """Return unit normals [N, 3], of either sign, of the planes through points and their neighbours [N, K].

    Each is the direction in which the neighbourhood is thinnest (Hoppe et al., Surface Reconstruction from Unorganized Points,
    SIGGRAPH 1992).
    """
    around = np.concatenate([points[neighbours], points[:, None]], axis=1)
    around = around - around.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    return axes[:, :, 0]
