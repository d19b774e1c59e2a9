"""Fit a body to one frame from nowhere: many starts, of which the better half is followed at each stage."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface, farthest_points
from snarfcli.registration.many_poses import kinematics, posed_many
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.rotations import vector_to_matrix
from snarfcli.registration.scan_grid import ScanGrid
from snarfcli.registration.scan_points import ScanPoints, with_normals
from snarfcli.registration.solver import Agreement, PosePrior, agreement, fit_state, scales

__all__ = ["Found", "PoseFinder"]

Array = NDArray[np.float64]

_POSES = 500  # of the library, each as far as possible from those before
_YAWS = 16
_TINY, _COARSE = 150, 300  # vertices of the surfaces that score starts and that follow them
_COARSE_POINTS = 500  # of the scan, for the following
_SHIFTS = 2  # steps that move a start onto the scan before it is scored
_CAP_M = 0.3  # a longer distance counts as this one when starts are scored
_SCORED = 100  # starts whose other side, from the scan to the body, is looked at
_OTHER_SIDE = 200  # points of the scan for it
# Each stage: starts at its beginning, steps of each, first and last scale in metres.
_STAGES = ((32, 5, 0.2, 0.1), (12, 6, 0.12, 0.06), (4, 8, 0.07, 0.04))
_LAST_STEPS, _LAST_SCALES_M = 10, (0.05, 0.03)  # of the best one, on all vertices


@dataclass(frozen=True)
class Found:
    """A state, and how well it agrees with the scan."""

    state: BodyState
    agreement: Agreement


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
        self._tiny = surface.take(farthest_points(surface.points_rest, _TINY))
        rotations = vector_to_matrix(library.poses)
        _, joints = kinematics(surface.parents, surface.joints_rest, rotations)
        self._rotations = rotations[farthest_points(joints.reshape(len(joints), -1), _POSES)]
        self._clouds = posed_many(self._tiny, self._rotations, np.zeros(surface.num_betas))

    def find(
        self, scan: ScanPoints, *, betas: Array | None = None, clothes_m: float = 0.0, near: Sequence[BodyState] = ()
    ) -> Found:
        """Fit one frame from anywhere.

        Args:
            scan: the points, in random order.
            betas: [S], shape parameters; without them the shape is free.
            clothes_m: the body may be so far below the surface without cost, metres.
            near: further starts, such as the states of frames close in time.
        """
        shape = np.zeros(self.surface.num_betas) if betas is None else betas
        free = betas is None and self.surface.num_betas > 0
        states = self._starts(scan, shape)
        coarse = ScanPoints(scan.points[:_COARSE_POINTS], scan.normals[:_COARSE_POINTS])
        for stage, (count, steps, first, last) in enumerate(_STAGES):
            states = [*near, *states[:count]] if stage == 1 else states[:count]
            followed = (
                fit_state(
                    self._coarse, state, coarse, scales(first, last, steps), self.prior, shape_is_free=free, clothes_m=clothes_m
                )
                for state in states
            )
            states = _best_first(self._coarse, followed, coarse)
        state = fit_state(
            self.surface,
            states[0],
            scan,
            scales(*_LAST_SCALES_M, _LAST_STEPS),
            self.prior,
            shape_is_free=free,
            clothes_m=clothes_m,
        )
        return Found(state, agreement(self.surface, state, scan))

    def _starts(self, scan: ScanPoints, betas: Array) -> list[BodyState]:
        """Return poses of the library, turned about y and placed on the scan, the best first."""
        grid = ScanGrid(scan)
        yaws = 2 * np.pi * np.arange(_YAWS) / _YAWS
        turns = vector_to_matrix(np.stack([np.zeros(_YAWS), yaws, np.zeros(_YAWS)], 1))
        placed = [_placed(self._clouds, turn, grid) for turn in turns]
        cost = np.stack([each[0] for each in placed])  # [yaws, poses]
        is_best = (cost <= np.roll(cost, 1, 0)) & (cost <= np.roll(cost, -1, 0))  # among neighbouring yaws
        order = np.argsort(np.where(is_best, cost, np.inf), axis=None)[:_SCORED]
        chosen = [np.unravel_index(number, cost.shape) for number in order]
        other = with_normals(scan.points[:_OTHER_SIDE], scan.normals[:_OTHER_SIDE])
        both = []
        for yaw, pose in chosen:
            points, normals = (cloud[pose] @ turns[yaw].T for cloud in self._clouds)
            body = with_normals(points + placed[yaw][1][pose], normals)
            both.append(cost[yaw, pose] + np.minimum(_distances(other, body).min(1), _CAP_M).mean())
        root = self.surface.joints_rest[0]
        states = []
        for number in np.argsort(both):
            yaw, pose = chosen[number]
            rotations = self._rotations[pose].copy()
            rotations[0] = turns[yaw] @ rotations[0]
            # the clouds are turned about the origin, a state about its root
            states.append(BodyState(rotations, placed[yaw][1][pose] + turns[yaw] @ root - root, betas))
        return states


def _placed(clouds: tuple[Array, Array], turn: Array, grid: ScanGrid) -> tuple[Array, Array]:
    """Turn clouds [C, K, 3] about y and move them onto the scan; return their costs [C] and shifts [C, 3], metres."""
    points, normals = (cloud @ turn.T for cloud in clouds)
    shift = grid.scan.centre - (points.max(1) + points.min(1)) / 2
    for _ in range(_SHIFTS):
        moved = points + shift[:, None]
        away = grid.scan.points[grid.closest(moved)] - moved
        length = np.linalg.norm(away, axis=2, keepdims=True)
        shift = shift + (away * np.minimum(1.0, _CAP_M / np.maximum(length, _CAP_M))).mean(1)
    moved = points + shift[:, None]
    closest = grid.closest(moved)
    apart = with_normals(
        (grid.scan.points[closest] - moved).reshape(-1, 3), (grid.scan.normals[closest] - normals).reshape(-1, 3)
    )
    return np.minimum(np.linalg.norm(apart, axis=1), _CAP_M).reshape(len(points), -1).mean(1), shift


def _distances(one: Array, other: Array) -> Array:
    """Return the distances [N, M] between points [N, D] and [M, D]."""
    squared = np.square(one).sum(1)[:, None] + np.square(other).sum(1) - 2 * one @ other.T
    return np.sqrt(np.maximum(squared, 0.0))


def _best_first(surface: BodySurface, states: Iterable[BodyState], scan: ScanPoints) -> list[BodyState]:
    return sorted(states, key=lambda state: agreement(surface, state, scan).objective)
