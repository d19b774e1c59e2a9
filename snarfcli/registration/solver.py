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

from snarfcli.registration.body_surface import BodyState, BodySurface, PosedSurface
from snarfcli.registration.matches import ALL_DIRECTIONS, Matches, match, outside_clothes
from snarfcli.registration.scan_points import ScanPoints

__all__ = [
    "SHAPE_PRIOR",
    "PosePrior",
    "StepOptions",
    "equations",
    "fit_state",
    "moved",
    "scales",
    "step",
]

Array = NDArray[np.float64]

_DISAGREEING_WEIGHT = 0.02
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
    weights, pulls = _by_vertex(match(posed, scan), len(posed.points), options)
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


def _by_vertex(matches: Matches, count: int, options: StepOptions) -> tuple[Array, Array]:
    """Return the weights [K, 3, 3] and pulls [K, 3] of the vertices, summed over their matches."""
    height, offset = outside_clothes(matches, options.clothes_m)
    weight = matches.share / np.square(1 + np.square(offset).sum(1) / options.scale_m**2)
    weight = np.where(matches.agree, weight, _DISAGREEING_WEIGHT * weight)
    weight[matches.unseen] = 0.0
    pulls = weight[:, None] * (height[:, None] * matches.normals + ALL_DIRECTIONS * offset)
    outer = weight[:, None] * matches.normals[:, _ROW] * matches.normals[:, _COLUMN]
    outer[:, _IS_DIAGONAL] += (ALL_DIRECTIONS * weight)[:, None]
    values = np.concatenate([outer, pulls], 1)
    sums = values[:count]  # the first K matches are those of the K vertices, in order
    for column in range(values.shape[1]):
        sums[:, column] += np.bincount(matches.body[count:], values[count:, column], count)
    weights = sums[:, _ENTRY]
    weights[:, np.arange(3), np.arange(3)] += _LEAST_WEIGHT
    return weights, sums[:, 6:]


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
