"""One shape for a subject, from frames in which the body was found: joint least squares with the poses free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface, farthest_points
from snarfcli.registration.matches import agreement
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import SHAPE_PRIOR, PosePrior, StepOptions, equations, moved, scales

__all__ = ["FittedShape", "different_frames", "fit_shape"]

Array = NDArray[np.float64]

_SCALES_M = scales(0.08, 0.025, 12)
_LOST = 1.5  # times the median misfit; frames with more do not tell the shape


@dataclass(frozen=True)
class FittedShape:
    """One shape for several frames."""

    betas: Array
    """[S], shape parameters."""
    states: tuple[BodyState, ...]
    """Of the frames, with this shape."""
    misfit: Array
    """[F], of the frames, as in `Agreement`."""


def fit_shape(
    surface: BodySurface, frames: Sequence[tuple[ScanPoints, BodyState]], prior: PosePrior, *, clothes_m: float = 0.0
) -> FittedShape:
    """Fit one shape, and a pose for each frame.

    Args:
        surface: the body.
        frames: scans, and states near the right ones; a few may be wrong.
        prior: of the poses.
        clothes_m: depth that the body may have below the surface without cost, metres.

    Raises:
        ValueError: there are no frames.
    """
    if not frames:
        raise ValueError("frames: wanted at least one, got none")
    scans = [scan for scan, _ in frames]
    betas = np.median([state.betas for _, state in frames], 0)
    states = [replace(state, betas=betas) for _, state in frames]
    for scale in _SCALES_M:
        misfit = _misfit(surface, states, scans, clothes_m)
        states = _step(surface, states, scans, prior, StepOptions(float(scale), True, clothes_m=clothes_m), misfit)
    return FittedShape(states[0].betas, tuple(states), _misfit(surface, states, scans, clothes_m))


def different_frames(joints: Array, count: int) -> NDArray[np.intp]:
    """Return the numbers of at most `count` frames whose poses differ most, from joints [T, J, 3] in metres."""
    return np.sort(farthest_points((joints - joints[:, :1]).reshape(len(joints), -1), count))


def _step(
    surface: BodySurface,
    states: Sequence[BodyState],
    scans: Sequence[ScanPoints],
    prior: PosePrior,
    options: StepOptions,
    misfit: Array,
) -> list[BodyState]:
    """Take one step of all frames: their poses are eliminated from the equations of the shape."""
    poses = 3 * surface.num_joints + 3
    system = SHAPE_PRIOR * np.eye(surface.num_betas)
    gradient = SHAPE_PRIOR * states[0].betas
    eliminated = []
    for state, scan, is_lost in zip(states, scans, misfit > _LOST * np.median(misfit), strict=True):
        posed, of_frame, pull = equations(surface, state, scan, prior, options)
        to_shape = of_frame[:poses, poses:]
        solved = np.linalg.solve(of_frame[:poses, :poses], np.concatenate([pull[:poses, None], to_shape], 1))
        eliminated.append((posed, solved))
        if not is_lost:
            system += of_frame[poses:, poses:] - to_shape.T @ solved[:, 1:]
            gradient += pull[poses:] - to_shape.T @ solved[:, 0]
    of_shape = np.asarray(-np.linalg.solve(system, gradient), np.float64)
    return [
        moved(surface, state, posed, np.concatenate([-solved[:, 0] - solved[:, 1:] @ of_shape, of_shape]))
        for state, (posed, solved) in zip(states, eliminated, strict=True)
    ]


def _misfit(surface: BodySurface, states: Sequence[BodyState], scans: Sequence[ScanPoints], clothes_m: float) -> Array:
    return np.array(
        [agreement(surface, state, scan, clothes_m=clothes_m).misfit for state, scan in zip(states, scans, strict=True)]
    )
