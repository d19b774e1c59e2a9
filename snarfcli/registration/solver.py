"""Gauss-Newton steps that bring the surface of a body onto the points of a scan.

Every step matches the vertices of the body with the closest points of the scan, and points of the scan with the closest
vertices (by place and normal), and solves one small linear system for the turns of all joints, the place and, where it is free,
the shape. Matches are weighted by Geman-McClure's function of their distance, whose scale shrinks from step to step. A distance
counts fully along the normal of the scan (point-to-plane, Chen and Medioni 1992), and a little in all directions, which keeps
limbs from sliding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.registration.body_surface import BodyState, BodySurface, PosedSurface
from snarfcli.registration.scan_points import ScanPoints, with_normals

__all__ = [
    "SHAPE_PRIOR",
    "Agreement",
    "PosePrior",
    "StepOptions",
    "agreement",
    "equations",
    "fit_state",
    "moved",
    "scales",
    "step",
]

Array = NDArray[np.float64]

_LEAST_AGREEMENT = 0.2  # cosine between the normals of a match; with less, a match counts little
_DISAGREEING_WEIGHT = 0.02
_ALL_DIRECTIONS = 0.1  # weight of the distance in all directions, relative to that along the normal
_SCAN_POINTS = 1000  # of a scan that are matched with vertices; the vertices are matched with all points
_BEYOND_M, _BORDER_M = 0.03, 0.02  # a vertex further than this from the scan, and this near to its border, is not seen
_UNSEEN_M = 0.03  # distance that a vertex which is not seen counts as, so that hiding a limb is no gain
_LEAST_WEIGHT = 1e-12  # keeps the weights of a vertex positive definite
SHAPE_PRIOR = 1e-6  # per squared unit of a shape parameter; the weights of the matches of each side sum to 1, metres squared
_WEAK_WEIGHT = 2e-6  # of a pose, squared metres per squared radian
# Of deviations in units of the usual one, squared metres. Against the weak prior it halves the errors of the joints' rotations
# (8.3 to 4.2 degrees in 15 frames of built-in motions that the poses were not from); 5e-8 and 1e-6 do less.
_USUAL_WEIGHT = 2e-7
_LEAST_TURN_RAD = 0.1  # added to the usual deviation
_DAMPING = 1e-6  # relative to the mean of the diagonal
_LONGEST_TURN_RAD = 0.35  # in one step
_LONGEST_SHIFT_M = 0.2
_LONGEST_BETA = 1.0
_RESIDUAL_CAP_M = 0.1  # a longer distance counts as this one in the residual
_OBJECTIVE_M = 0.05  # scale of the objective
_ROW, _COLUMN = np.triu_indices(3)  # the six different entries of a symmetric matrix
_IS_DIAGONAL = _ROW == _COLUMN
_ENTRY = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True)
class PosePrior:
    """How poses usually are: a normal distribution of the rotation vectors of each joint but the root."""

    mean: Array
    """[J, 3], axis-angle, radians."""
    weight: Array
    """[J, 3], squared metres per squared radian: how much a deviation costs against the mean squared distance of matches."""

    @classmethod
    def weak(cls, joints: int, mean: Array | None = None, weight: float = _WEAK_WEIGHT) -> PosePrior:
        """Return a prior that matters only for turns which the scan does not show."""
        return cls(np.zeros((joints, 3)) if mean is None else mean, np.full((joints, 3), weight))

    @classmethod
    def of_poses(cls, poses: Array) -> PosePrior:
        """Return a prior by which turns that are unusual among known poses cost more, such as those of a knee to the side.

        Joints that never turn among the poses get the weak prior.

        Args:
            poses: [L, J, 3], axis-angle, radians.
        """
        variance = poses.var(0)
        turns = variance.max(1, keepdims=True) > 1e-6
        return cls(poses.mean(0), np.where(turns, _USUAL_WEIGHT / (variance + _LEAST_TURN_RAD**2), _WEAK_WEIGHT))


@dataclass(frozen=True)
class StepOptions:
    """What a step may change, and how it weighs matches."""

    scale_m: float
    """Distance at which a match has a quarter of its weight, metres."""
    shape_is_free: bool = False
    """Change the shape parameters, too."""
    clothes_m: float = 0.0
    """Depth below the surface of the scan that the body may have without cost, metres."""


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


@dataclass(frozen=True)
class _Matches:
    body: NDArray[np.intp]  # [K + M] numbers of vertices; K matches of vertices, then M of points
    points: Array  # [K + M, 3]
    normals: Array  # [K + M, 3]
    agree: NDArray[np.bool_]  # [K + M]
    offset: Array  # [K + M, 3] from the point of the scan to the vertex, metres
    share: Array  # [K + M] 1 / K or 1 / M
    unseen: NDArray[np.bool_]  # [K + M] vertices whose place the scan does not show


def scales(first_m: float, last_m: float, steps: int) -> Array:
    """Return the scales of a number of steps, metres, falling evenly by ratio."""
    return np.geomspace(first_m, last_m, steps)


def fit_state(
    surface: BodySurface,
    state: BodyState,
    scan: ScanPoints,
    scales_m: Sequence[float] | Array,
    prior: PosePrior,
    *,
    shape_is_free: bool = False,
    clothes_m: float = 0.0,
) -> BodyState:
    """Take one step per scale; arguments as in `step` and `StepOptions`."""
    for scale in scales_m:
        state = step(surface, state, scan, prior, StepOptions(float(scale), shape_is_free, clothes_m))
    return state


def step(surface: BodySurface, state: BodyState, scan: ScanPoints, prior: PosePrior, options: StepOptions) -> BodyState:
    """Take one step.

    Args:
        surface: the body.
        state: where it is.
        scan: the points.
        prior: of the pose.
        options: of the step.
    """
    posed, system, gradient = equations(surface, state, scan, prior, options)
    shape = np.arange(3 * surface.num_joints + 3, len(system))
    system[shape, shape] += SHAPE_PRIOR
    gradient[shape] += SHAPE_PRIOR * state.betas[: len(shape)]
    return moved(surface, state, posed, np.asarray(-np.linalg.solve(system, gradient), np.float64))


def equations(
    surface: BodySurface, state: BodyState, scan: ScanPoints, prior: PosePrior, options: StepOptions
) -> tuple[PosedSurface, Array, Array]:
    """Return the posed surface and the damped normal equations of a step without the prior of the shape.

    Args:
        surface, state, scan, prior, options: as in `step`.

    Returns:
        posed: the surface in the state.
        system: [D, D], D = 3 J + 3, and S more where the shape is free.
        gradient: [D], of half the cost.
    """
    posed, derivatives = surface.posed_with_derivatives(state)
    if not options.shape_is_free:
        derivatives = replace(derivatives, by_beta=derivatives.by_beta[:, :, :0])
    weights, pulls = _by_vertex(_match(posed, scan), len(posed.points), options)
    system, gradient = derivatives.normal_equations(weights, pulls)
    _add_prior(system, gradient, surface, state, posed, prior)
    system[np.diag_indices(len(system))] += _DAMPING * np.trace(system) / len(system)
    return posed, system, gradient


def moved(surface: BodySurface, state: BodyState, posed: PosedSurface, change: Array) -> BodyState:
    """Return a state after a change [3 J + 3] or [3 J + 3 + S], of which turns, shift and shape parameters are kept short.

    Args:
        surface: the body.
        state: before.
        posed: the surface in this state.
        change: turns of the joints in the axes of the posed frame, radians; shift, metres; shape parameters.
    """
    turns = 3 * surface.num_joints
    turned = _at_most(change[:turns].reshape(-1, 3), _LONGEST_TURN_RAD)
    translation = state.translation + _at_most(change[turns : turns + 3], _LONGEST_SHIFT_M)
    betas = state.betas
    if len(change) > turns + 3:
        betas = betas + np.clip(change[turns + 3 :], -_LONGEST_BETA, _LONGEST_BETA)
    return BodyState(surface.turned(state, posed, turned), translation, betas)


def agreement(surface: BodySurface, state: BodyState, scan: ScanPoints, *, clothes_m: float = 0.0) -> Agreement:
    """Measure how well a body agrees with a scan.

    Args:
        surface: the body.
        state: where it is.
        scan: the points.
        clothes_m: depth that the body may have below the surface without misfit, metres.
    """
    matches = _match(surface.posed(state), scan)
    count = len(surface.points_rest)
    squared = np.square(matches.offset).sum(1)
    height, offset = _outside_clothes(matches, clothes_m)
    apart = np.square(offset).sum(1)
    apart = np.where(matches.agree, np.square(height) + _ALL_DIRECTIONS * apart, apart)
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


def _residual_m(matches: _Matches) -> float:
    """Return the residual of an agreement."""
    distance = np.linalg.norm(matches.offset, axis=1)
    along = np.where(matches.agree, np.abs((matches.offset * matches.normals).sum(1)), distance)
    counts = np.where(matches.unseen, 0.0, matches.share)
    far = distance > _RESIDUAL_CAP_M  # a height says nothing about a match that is far to the side
    return float((counts * np.where(far, _RESIDUAL_CAP_M, along)).sum() / counts.sum())


def _match(posed: PosedSurface, scan: ScanPoints) -> _Matches:
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
    return _Matches(body, points, normals, agree, offset, share, _unseen(posed, scan, offset))


def _unseen(posed: PosedSurface, scan: ScanPoints, offset: Array) -> NDArray[np.bool_]:
    """Return which matches are of vertices beyond the border of the scan: away from their points, and no closer to others."""
    unseen = np.zeros(len(offset), bool)
    if scan.border is not None:
        apart = np.linalg.norm(offset[: len(posed.points)], axis=1)
        unseen[: len(apart)] = (apart > _BEYOND_M) & (scan.border.query(posed.points)[0] < apart + _BORDER_M)
    return unseen


def _by_vertex(matches: _Matches, count: int, options: StepOptions) -> tuple[Array, Array]:
    """Return the weights [K, 3, 3] and pulls [K, 3] of the vertices, summed over their matches."""
    height, offset = _outside_clothes(matches, options.clothes_m)
    weight = matches.share / np.square(1 + np.square(offset).sum(1) / options.scale_m**2)
    weight = np.where(matches.agree, weight, _DISAGREEING_WEIGHT * weight)
    weight[matches.unseen] = 0.0
    pulls = weight[:, None] * (height[:, None] * matches.normals + _ALL_DIRECTIONS * offset)
    outer = weight[:, None] * matches.normals[:, _ROW] * matches.normals[:, _COLUMN]
    outer[:, _IS_DIAGONAL] += (_ALL_DIRECTIONS * weight)[:, None]
    values = np.concatenate([outer, pulls], 1)
    sums = values[:count]  # the first K matches are those of the K vertices, in order
    for column in range(values.shape[1]):
        sums[:, column] += np.bincount(matches.body[count:], values[count:, column], count)
    weights = sums[:, _ENTRY]
    weights[:, np.arange(3), np.arange(3)] += _LEAST_WEIGHT
    return weights, sums[:, 6:]


def _outside_clothes(matches: _Matches, clothes_m: float) -> tuple[Array, Array]:
    """Return the heights [N] above the scan and the offsets [N, 3] from it, metres; depths up to `clothes_m` count as none."""
    height = (matches.offset * matches.normals).sum(1)
    free = np.clip(height, -clothes_m, 0.0)
    return height - free, matches.offset - free[:, None] * matches.normals


def _add_prior(
    system: Array, gradient: Array, surface: BodySurface, state: BodyState, posed: PosedSurface, prior: PosePrior
) -> None:
    """Add the cost of an unusual pose; a small turn in the axes of the parent is taken as a change of the rotation vector."""
    deviation = state.pose - prior.mean
    for joint, parent in enumerate(surface.parents):
        if parent < 0:
            continue
        block, axes = slice(3 * joint, 3 * joint + 3), posed.turns[parent]
        system[block, block] += (axes * prior.weight[joint]) @ axes.T
        gradient[block] += axes @ (prior.weight[joint] * deviation[joint])


def _at_most(vectors: Array, longest: float) -> Array:
    """Return vectors [..., 3], shortened to a length of at most `longest`."""
    return vectors * (longest / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), longest))
