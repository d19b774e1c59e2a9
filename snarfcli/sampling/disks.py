"""Points spread evenly over triangles by Poisson disks: none is closer to another than the radius of a disk."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from snarfcli.sampling.triangles import uniform_in_triangles

__all__ = ["poisson_disks"]

# Number of times that as many candidates are drawn as samples are wanted. With six rounds the standard deviation of the spacing
# is 10 %, as with MeshLab's settings in surface.py; ten rounds take twice as long for 9 %.
_ROUNDS = 6
# Squared radius of a disk over the area per sample: 1.01 to 1.04 times as many disks as wanted, from 1,000 on, fit on a body, a
# sphere, a thin capsule and a box. On a sheet thinner than the radius, whose sides count as one, it is 0.6 times as many.
_DISK = 0.49


def poisson_disks(corners: np.ndarray, areas: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Return about `count` points, mostly a few more, that keep the same distance from each other.

    Candidates are drawn uniformly; each is kept if no earlier one that was kept lies within the radius (dart throwing). The
    same generator gives the same points.

    Args:
        corners: of the triangles, [F, 3, 3], metres.
        areas: of the triangles, [F].
        count: number of points wanted.
        generator: source of random numbers.

    Returns:
        [about count, 3] float64, metres.
    """
    radius = float(np.sqrt(_DISK * areas.sum() / max(1, count)))
    kept = np.zeros((0, 3))
    for _ in range(_ROUNDS):
        points = uniform_in_triangles(corners, areas, count, generator)
        if len(kept):
            distance, _ = KDTree(kept).query(points, distance_upper_bound=radius)  # infinite if none is within the radius
            points = points[np.asarray(distance) > radius]
        kept = np.concatenate([kept, points[_first_come(points, radius)]])
    return kept


def _first_come(points: np.ndarray, radius: float) -> np.ndarray:
    """Return which of the points [N, 3] to keep, [N] bool: those not within the radius of an earlier one that is kept."""
    is_kept = np.ones(len(points), bool)
    pairs = KDTree(points).query_pairs(radius, output_type="ndarray") if len(points) else np.zeros((0, 2), np.intp)
    while len(pairs):
        earlier, later = pairs.T
        has_earlier = np.zeros(len(points), bool)
        has_earlier[later] = True
        dropped = np.zeros(len(points), bool)
        dropped[later[~has_earlier[earlier]]] = True  # within the radius of one that nothing can drop any more
        is_kept &= ~dropped
        pairs = pairs[~(dropped[earlier] | dropped[later])]
    return is_kept
