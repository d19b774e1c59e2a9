"""Matches between the vertices of a body and the points of a scan, and how well the two agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.registration.body_surface import BodyState, BodySurface, PosedSurface
from snarfcli.registration.scan_points import ScanPoints, with_normals

__all__ = ["ALL_DIRECTIONS", "Agreement", "Matches", "agreement", "match", "outside_clothes", "with_matches_by_place"]

Array = NDArray[np.float64]

ALL_DIRECTIONS = 0.1
"""Weight of the distance in all directions, relative to that along the normal."""

_LEAST_AGREEMENT = 0.2  # cosine between the normals of a match; with less, a match counts little
_SCAN_POINTS = 1000  # of a scan that are matched with vertices; the vertices are matched with all points
_BEYOND_M, _BORDER_M = 0.03, 0.02  # a vertex further than this from the scan, and this near to its border, is not seen
_UNSEEN_M = 0.03  # distance that a vertex which is not seen counts as, so that hiding a limb is no gain
_RESIDUAL_CAP_M = 0.1  # a longer distance counts as this one in the residual
_OBJECTIVE_M = 0.05  # scale of the objective


@dataclass(frozen=True)
class Matches:
    """Pairs of vertices and points: first the point that is closest to each of K vertices, then the reverse for M points."""

    body: NDArray[np.intp]
    """[K + M], numbers of the vertices."""
    points: Array
    """[K + M, 3], metres."""
    normals: Array
    """[K + M, 3], of the points."""
    agree: NDArray[np.bool_]
    """[K + M], whether the normals of both point to the same side."""
    offset: Array
    """[K + M, 3], from the point to the vertex, metres."""
    share: Array
    """[K + M], 1 / K, or 1 / M."""
    unseen: NDArray[np.bool_]
    """[K + M], whether it is of a vertex whose place the scan does not show."""


@dataclass(frozen=True)
class Agreement:
    """How well a body and a scan agree."""

    objective: float
    """Mean robust distance of both sides, from 0 (perfect) to 2 (nothing matches)."""
    misfit: float
    """The same of what a step makes small: distances along the surface count a tenth, those inside the clothes nothing. Unlike
    the objective it hardly has a share that comes from the spacing of the vertices, so it tells lost limbs better."""
    residual_m: float
    """Mean distance of both sides, metres: along the normal of the scan where the normals agree, so that the spacing of the
    points hardly counts. Distances above 10 cm count as 10 cm; vertices beyond the border of the scan do not count."""
    of_body: Array
    """[K], distance from each vertex to its match, metres; of those beyond the border of the scan, at most 3 cm."""
    of_scan: Array
    """[M], distance from each of the first M points of the scan to its match, metres."""
    partners: NDArray[np.intp]
    """[M], numbers of these matches among the body's vertices."""


def agreement(surface: BodySurface, state: BodyState, scan: ScanPoints, *, clothes_m: float = 0.0) -> Agreement:
    """Measure how well a body agrees with a scan.

    Args:
        surface: the body.
        state: where it is.
        scan: the points.
        clothes_m: depth that the body may have below the surface without misfit, metres.
    """
    matches = match(surface.posed(state), scan)
    count = len(surface.points_rest)
    squared = np.square(matches.offset).sum(1)
    height, offset = outside_clothes(matches, clothes_m)
    apart = np.square(offset).sum(1)
    apart = np.where(matches.agree, np.square(height) + ALL_DIRECTIONS * apart, apart)
    apart, squared = (np.where(matches.unseen, np.minimum(_UNSEEN_M**2, each), each) for each in (apart, squared))
    distance = np.sqrt(squared)
    return Agreement(
        objective=float((matches.share * squared / (squared + _OBJECTIVE_M**2)).sum()),
        misfit=float((matches.share * apart / (apart + _OBJECTIVE_M**2)).sum()),
        residual_m=_residual_m(matches),
        of_body=distance[:count],
        of_scan=distance[count:],
        partners=matches.body[count:],
    )


def with_matches_by_place(found: Agreement, surface: BodySurface, state: BodyState, scan: ScanPoints) -> Agreement:
    """Return an agreement whose `of_body`, `of_scan` and `partners` are those of the closest places; normals do not count.

    At thin parts, normals cannot be estimated from points, so that matches by normals are far although the pose is right.
    """
    posed = surface.posed(state)
    away, nearest = KDTree(scan.points).query(posed.points)
    unseen = _unseen(posed, scan, posed.points - scan.points[nearest])
    of_scan, partners = KDTree(posed.points).query(scan.points[:_SCAN_POINTS])
    return replace(found, of_body=np.where(unseen, np.minimum(_UNSEEN_M, away), away), of_scan=of_scan, partners=partners)


def match(posed: PosedSurface, scan: ScanPoints) -> Matches:
    """Match every vertex with a point, and some points with a vertex."""
    features = with_normals(posed.points, posed.normals)
    _, partner = scan.tree.query(features)
    count = min(_SCAN_POINTS, len(scan))  # the points of a scan are in random order
    _, back = KDTree(features).query(scan.features[:count])
    body = np.concatenate([np.arange(len(features)), back])
    chosen = np.concatenate([partner, np.arange(count)])
    points, normals = scan.points[chosen], scan.normals[chosen]
    agree = (posed.normals[body] * normals).sum(1) > _LEAST_AGREEMENT
    share = np.concatenate([np.full(len(features), 1 / len(features)), np.full(count, 1 / count)])
    offset = posed.points[body] - points
    return Matches(body, points, normals, agree, offset, share, _unseen(posed, scan, offset))


def _unseen(posed: PosedSurface, scan: ScanPoints, offset: Array) -> NDArray[np.bool_]:
    """Return which matches are of vertices beyond the border of the scan: away from their points, and no closer to others."""
    unseen = np.zeros(len(offset), bool)
    if scan.border is not None:
        apart = np.linalg.norm(offset[: len(posed.points)], axis=1)
        unseen[: len(apart)] = (apart > _BEYOND_M) & (scan.border.query(posed.points)[0] < apart + _BORDER_M)
    return unseen


def outside_clothes(matches: Matches, clothes_m: float) -> tuple[Array, Array]:
    """Return the heights [N] above the scan and the offsets [N, 3] from it, metres; depths up to `clothes_m` count as none."""
    height = (matches.offset * matches.normals).sum(1)
    free = np.clip(height, -clothes_m, 0.0)
    return height - free, matches.offset - free[:, None] * matches.normals


def _residual_m(matches: Matches) -> float:
    """Return the residual of an agreement."""
    distance = np.linalg.norm(matches.offset, axis=1)
    along = np.where(matches.agree, np.abs((matches.offset * matches.normals).sum(1)), distance)
    counts = np.where(matches.unseen, 0.0, matches.share)
    far = distance > _RESIDUAL_CAP_M  # a height says nothing about a match that is far to the side
    return float((counts * np.where(far, _RESIDUAL_CAP_M, along)).sum() / counts.sum())
