"""Fit a body to one frame from nowhere: many starts, of which the better ones are followed at each stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface, farthest_points
from snarfcli.registration.joint_limits import random_poses
from snarfcli.registration.kinematics import kinematics
from snarfcli.registration.limbs import doubtful_limbs, find_limbs, limb_candidates
from snarfcli.registration.matches import Agreement, agreement
from snarfcli.registration.placing import StartClouds
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.rotations import vector_to_matrix
from snarfcli.registration.scan_grid import ScanGrid
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior, fit_state, scales

__all__ = ["Found", "PoseFinder"]

Array = NDArray[np.float64]

_POSES = 500  # of the library, each as far as possible from those before
_TILTED_POSES = 100  # of these, that are also tilted
_TILTS_DEG = ((60, 0, 0), (110, 0, 0), (-60, 0, 0), (-110, 0, 0), (0, 0, 90), (0, 0, -90))
_RANDOM_POSES = 1000  # from which those of limbs are taken
_COARSE, _COARSE_POINTS = 300, 500  # vertices and points of the scan, with which starts are followed
_LAST_STEPS = 10
_LAST_SCALES_M = (0.05, 0.03)
_LIMB_CANDIDATES, _LIMB_STEPS, _LIMB_SCALES_M = 5, 6, (0.12, 0.05)
_LIMB_ROUNDS = (1.0, 1.0, 2.0)  # the most cost of a limb's poses that are followed, relative to the pose that it has
_BETTER = 0.985  # of the objective before, which a better limb leaves at most
_TRIED_TO_THE_END = 2  # states whose limbs are looked at
_ALIKE_RAD = 0.8  # roots turned by less than this against each other are alike


@dataclass(frozen=True)
class _Stage:
    starts: int
    alike: int  # at most, of starts whose roots are alike
    steps: int
    scales_m: tuple[float, float]


_STAGES = (
    _Stage(40, 3, 5, (0.2, 0.1)),
    _Stage(14, 3, 6, (0.12, 0.06)),
    _Stage(5, 2, 8, (0.07, 0.04)),
)


@dataclass(frozen=True)
class Found:
    """A state, and how well it agrees with the scan."""

    state: BodyState
    agreement: Agreement


@dataclass(frozen=True, eq=False)
class _Frame:
    """A scan, and how a body is fitted to it: coarsely, but judged by all vertices."""

    surface: BodySurface
    coarse: BodySurface
    prior: PosePrior
    scan: ScanPoints
    shape_is_free: bool
    clothes_m: float

    def judged(self, state: BodyState) -> Found:
        """Return the state with its agreement."""
        return Found(state, agreement(self.surface, state, self.scan, clothes_m=self.clothes_m))

    def followed(self, state: BodyState, steps: int, scales_m: tuple[float, float]) -> Found:
        """Return the state after some steps of a few vertices."""
        return self.judged(self._fit(self.coarse, self.scan.first(_COARSE_POINTS), state, steps, scales_m))

    def finished(self, state: BodyState) -> Found:
        """Return the state after the last steps, of all vertices."""
        return self.judged(self._fit(self.surface, self.scan, state, _LAST_STEPS, _LAST_SCALES_M))

    def _fit(
        self, surface: BodySurface, scan: ScanPoints, state: BodyState, steps: int, scales_m: tuple[float, float]
    ) -> BodyState:
        along = scales(*scales_m, steps)
        return fit_state(surface, state, scan, along, self.prior, shape_is_free=self.shape_is_free, clothes_m=self.clothes_m)


class PoseFinder:
    """Finds the pose, the place and, where it is free, the shape of a body in single frames."""

    def __init__(self, surface: BodySurface, library: PoseLibrary, prior: PosePrior) -> None:
        """Prepare the starts.

        Args:
            surface: the body.
            library: poses to start from.
            prior: of the pose.
        """
        self.surface, self.prior = surface, prior
        self._coarse = surface.take(farthest_points(surface.points_rest, _COARSE))
        rotations = vector_to_matrix(library.poses)
        _, joints = kinematics(surface.parents, surface.joints_rest, rotations)
        spread = rotations[farthest_points(joints.reshape(len(joints), -1), _POSES)]
        self._starts = StartClouds(surface, np.concatenate([spread, _tilted(spread[:_TILTED_POSES])]))
        by_chance = random_poses(surface.joint_names, _RANDOM_POSES)
        self._limbs = find_limbs(self._coarse, rotations, None if by_chance is None else vector_to_matrix(by_chance))

    def find(
        self, scan: ScanPoints, *, betas: Array | None = None, clothes_m: float = 0.0, near: Sequence[BodyState] = ()
    ) -> Found:
        """Fit one frame from anywhere.

        Args:
            scan: the points, in random order.
            betas: [S], shape parameters; without them the shape is free.
            clothes_m: depth that the body may have below the surface without cost, metres.
            near: further starts, such as the states of frames close in time.
        """
        if betas is not None:
            near = [replace(state, betas=betas) for state in near]
        grid = ScanGrid(scan)
        frame = self._frame(scan, betas is None, clothes_m)
        states = self._starts.placed(grid, np.zeros(self.surface.num_betas) if betas is None else betas)
        for number, stage in enumerate(_STAGES):
            states = _unlike(states, stage.starts, stage.alike) + ([*near] if number == 1 else [])
            followed = [frame.followed(state, stage.steps, stage.scales_m) for state in states]
            states = [each.state for each in sorted(followed, key=_objective)]
        tried = []
        for state in _unlike(states, _TRIED_TO_THE_END, 1):
            tried.append(self._with_better_limbs(frame.judged(state), frame, grid))
            if not doubtful_limbs(self.surface, self._limbs, tried[-1].agreement):
                break
        return frame.finished(min(tried, key=_objective).state)

    def recover(self, scan: ScanPoints, state: BodyState, *, clothes_m: float = 0.0) -> Found:
        """Fit one frame from a state whose single limbs may be wrong; the shape stays.

        Args:
            scan: the points, in random order.
            state: to start from.
            clothes_m: depth that the body may have below the surface without cost, metres.
        """
        frame = self._frame(scan, False, clothes_m)
        return frame.finished(self._with_better_limbs(frame.judged(state), frame, ScanGrid(scan)).state)

    def _frame(self, scan: ScanPoints, shape_is_free: bool, clothes_m: float) -> _Frame:
        return _Frame(self.surface, self._coarse, self.prior, scan, shape_is_free and self.surface.num_betas > 0, clothes_m)

    def _with_better_limbs(self, found: Found, frame: _Frame, grid: ScanGrid) -> Found:
        """Try other poses of each doubtful limb."""
        for most_cost in _LIMB_ROUNDS:
            for limb in self._limbs:
                if limb in doubtful_limbs(self.surface, self._limbs, found.agreement):
                    candidates = limb_candidates(self._coarse, found.state, limb, grid, _LIMB_CANDIDATES, most_cost)
                    followed = [frame.followed(state, _LIMB_STEPS, _LIMB_SCALES_M) for state in candidates]
                    best = min(followed, key=_objective, default=found)
                    found = best if _objective(best) < _BETTER * _objective(found) else found
        return found


def _objective(found: Found) -> float:
    return found.agreement.objective


def _tilted(rotations: Array) -> Array:
    """Return poses [C, J, 3, 3] tilted forwards, backwards and to the sides, as of bodies that bend or lie."""
    tilts = vector_to_matrix(np.radians(_TILTS_DEG))
    tilted = np.tile(rotations, (len(tilts), 1, 1, 1))
    tilted[:, 0] = np.repeat(tilts, len(rotations), 0) @ tilted[:, 0]
    return tilted


def _unlike(states: Sequence[BodyState], count: int, alike: int) -> list[BodyState]:
    """Return the first `count` of some states without more than `alike` whose roots are turned alike."""
    chosen: list[BodyState] = []
    for state in states:
        cosines = [(np.trace(other.rotations[0].T @ state.rotations[0]) - 1) / 2 for other in chosen]
        if sum(cosine > np.cos(_ALIKE_RAD) for cosine in cosines) < alike:
            chosen.append(state)
        if len(chosen) == count:
            break
    return chosen
