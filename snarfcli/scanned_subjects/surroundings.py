"""What a scan shows besides the subject: a floor, and things that stand apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

__all__ = ["AXES", "Floor", "Part", "find_floor", "find_parts", "robust_box", "without_surroundings"]

Array = NDArray[np.float64]

AXES = {"y": 1, "z": 2}
"""Number of the coordinate of each up axis."""

# Lengths of this module are shares of the longest side of what is seen, which is 1 to 4 m: the unit need not be known.
_TOLERANCE = 0.006  # of the distance from a floor: 1 cm for a standing person
_STEEPEST = 0.94  # cosine between the up axis and the normal of a floor: 20 degrees
_ALONG = 0.88  # cosine between the normal of a point on the floor and that of the floor; estimated normals are rough
_TRIES = 60
_LEAST_SHARE = 0.06  # of all points on a floor; the soles of a standing person have about 0.04
_BELOW = 0.03  # share of points that may be below a floor
_CELL = 0.04
_BEYOND = 0.35  # share of the cells of a floor that are below nothing; a lying person covers its flat back
_ROUGHNESS, _MARGIN = 3.0, 0.002  # points up to this many standard deviations, and this length, above a floor belong to it
_MEASURED = 4000  # points

_LINK = 0.035  # points closer than this are connected: 6 cm; 4,000 points on a person are 2 cm apart
_SPARSE_LINKS = 4.0  # times the usual distance between neighbours, for scans with few points
_LINKED = 10_000  # points, by whose links the parts of a denser scan are found: links grow with the square of their number
_SMALLEST_PART = 0.01  # share of the points; smaller parts are stray points
_LOOSE_GAP = 0.07  # a part this near belongs to the subject: the scan has a hole between
_LIMB_GAP, _LIMB_SHARE = 0.17, 0.2  # so does a small part, such as a forearm, at this distance


@dataclass(frozen=True)
class Floor:
    """A plane below the subject."""

    up: str
    """Up axis: y or z."""
    normal: Array
    """[3], unit length, upward."""
    height: float
    """Of the plane above the origin, along the normal, units of the points."""
    tolerance: float
    """Points up to this height above it belong to it, units of the points."""

    def is_above(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point [P, 3] is above the floor."""
        return points @ self.normal - self.height > self.tolerance


@dataclass(frozen=True)
class Part:
    """A connected part of a scan."""

    is_in: NDArray[np.bool_]
    """[P], whether each point belongs to it."""
    length: float
    """Its longest side, units of the points."""


def robust_box(points: Array, share: float = 0.005) -> tuple[Array, Array]:
    """Return the lower and the upper corner [3] of a box that leaves out a share of the points on each side."""
    return np.quantile(points, share, 0), np.quantile(points, 1 - share, 0)


def find_floor(points: Array, normals: Array, ups: tuple[str, ...] = ("y", "z"), seed: int = 0) -> Floor | None:
    """Return the floor that a scan shows, None if it shows none.

    A floor is nearly level, has points of its own normal that also lie beside what stands on it, and hardly any points are
    below it.

    Args:
        points: [P, 3], any unit.
        normals: [P, 3], unit length.
        ups: up axes that are possible.
        seed: of the planes that are tried.
    """
    draws = np.random.default_rng(seed)
    some = draws.permutation(len(points))[:_MEASURED]
    points, normals = points[some], normals[some]
    lower, upper = robust_box(points)
    length = float((upper - lower).max())
    found = [_floor_along(points, normals, up, length, draws) for up in ups] if length > 0 else []
    best = max((pair for pair in found if pair is not None), key=lambda pair: pair[0], default=None)
    return None if best is None else best[1]


def _floor_along(points: Array, normals: Array, up: str, length: float, draws: np.random.Generator) -> tuple[int, Floor] | None:
    """Return the floor for one up axis and the number of its points."""
    axis, tolerance = AXES[up], _TOLERANCE * length
    level = np.flatnonzero(np.abs(normals[:, axis]) > _ALONG)
    if len(level) < _LEAST_SHARE * len(points):
        return None
    level_points = points[level]
    best: tuple[int, Array, float] | None = None
    for _ in range(_TRIES):
        normal = np.eye(3)[axis]
        height = float(level_points[draws.integers(len(level)), axis])
        for reach in (4, 2, 1):  # the plane through the point, refined with more and more exact members
            near = level_points[np.abs(level_points @ normal - height) < reach * tolerance]
            if len(near) < 10:
                break
            normal, height = _plane(near, axis)
        count = int((np.abs(level_points @ normal - height) < tolerance).sum())
        if normal[axis] > _STEEPEST and (best is None or count > best[0]):
            best = count, normal, height
    if best is None or best[0] < _LEAST_SHARE * len(points):
        return None
    count, normal, height = best
    above = points @ normal - height
    if (above < -3 * tolerance).mean() > _BELOW:
        return None
    on_it = level_points[np.abs(level_points @ normal - height) < tolerance]
    if _share_beyond(on_it, points[above > 3 * tolerance], axis, _CELL * length) < _BEYOND:
        return None
    spread = float((on_it @ normal - height).std())
    return count, Floor(up, normal, height, _ROUGHNESS * spread + _MARGIN * length)


def _plane(points: Array, axis: int) -> tuple[Array, float]:
    """Return the normal [3], with a positive component along an axis, and the height of the plane through points."""
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal if normal[axis] > 0 else -normal
    return normal, float(middle @ normal)


def _share_beyond(floor: Array, others: Array, axis: int, cell: float) -> float:
    """Return the share of the cells with points of a floor that have no other points above."""
    level = [number for number in range(3) if number != axis]
    covered = {tuple(place) for place in np.floor(others[:, level] / cell).astype(np.int64)}
    cells = {tuple(place) for place in np.floor(floor[:, level] / cell).astype(np.int64)}
    return len(cells - covered) / max(1, len(cells))


def find_parts(points: Array) -> list[Part]:
    """Return the connected parts of a scan without stray points; the first is the largest, with the loose pieces near it.

    Args:
        points: [P, 3], any unit, without a floor.
    """
    lower, upper = robust_box(points)
    length = float((upper - lower).max())
    labels = _labels(points, _LINK * length)
    sizes = np.bincount(labels)
    order = [label for label in np.argsort(-sizes, kind="stable") if sizes[label] >= _SMALLEST_PART * len(points)]
    if len(order) < 2:  # also if all points are far apart
        return [_part(points, labels == order[0] if order else np.ones(len(points), bool))]
    main = labels == order[0]
    apart: list[Part] = []
    nearest = KDTree(points[main])
    for label in order[1:]:
        members = labels == label
        gap = float(nearest.query(points[members])[0].min()) / max(length, 1e-12)
        if gap < _LOOSE_GAP or (gap < _LIMB_GAP and sizes[label] < _LIMB_SHARE * sizes[order[0]]):
            main = main | members
        else:
            apart.append(_part(points, members))
    return [_part(points, main), *apart]


def _labels(points: Array, link: float) -> NDArray[np.intp]:
    """Return the number of the connected part of each point [P]; `link` is the distance below which points are connected."""
    linked = points
    if len(points) > _LINKED:
        linked = points[np.random.default_rng(0).permutation(len(points))[:_LINKED]]
    tree = KDTree(linked)
    usual = float(np.median(tree.query(linked[:500], 2)[0][:, 1]))
    pairs = tree.query_pairs(max(link, _SPARSE_LINKS * usual), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), (len(linked), len(linked)))
    labels = np.asarray(connected_components(graph, directed=False)[1], np.intp)
    return labels if linked is points else labels[np.asarray(tree.query(points)[1])]


def without_surroundings(points: Array, normals: Array, floor: Floor | None, *, has_parts: bool = False) -> tuple[Array, Array]:
    """Return the points and normals [P, 3] of the subject alone.

    Args:
        points: [P, 3], any unit.
        normals: [P, 3].
        floor: that is left out, None for none.
        has_parts: whether things that stand apart are left out too.
    """
    if floor is not None:
        is_above = floor.is_above(points)
        points, normals = points[is_above], normals[is_above]
    if has_parts and len(points) > 1:
        is_in = find_parts(points)[0].is_in
        points, normals = points[is_in], normals[is_in]
    return points, normals


def _part(points: Array, is_in: NDArray[np.bool_]) -> Part:
    lower, upper = robust_box(points[is_in])
    return Part(is_in, float((upper - lower).max()))
