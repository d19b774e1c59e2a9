"""Poses turned about y and placed on a scan, ordered by how well they fit: thousands of starts, before any is followed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface, farthest_points
from snarfcli.registration.limbs import squared_distances
from snarfcli.registration.many_poses import posed_many
from snarfcli.registration.rotations import vector_to_matrix
from snarfcli.registration.scan_grid import ScanGrid
from snarfcli.registration.scan_points import with_normals

__all__ = ["StartClouds"]

Array = NDArray[np.float64]

_VERTICES = 150
_YAWS = 16
_SHIFTS = 2  # steps that move a start onto the scan before it is scored
_CAP_M = 0.3  # a longer distance counts as this one
_SCORED = 8  # starts per yaw, of upright and of leaning poses, whose other side, from the scan to the body, is looked at
_LEANING = 0.7  # cosine between the root's y axis and the vertical; with less a pose leans
_OTHER_SIDE = 200  # points of the scan for it


class StartClouds:
    """A few vertices of a body in many poses."""

    def __init__(self, surface: BodySurface, rotations: Array) -> None:
        """Pose the body.

        Args:
            surface: the body.
            rotations: [C, J, 3, 3], relative to the parents.
        """
        few = surface.take(farthest_points(surface.points_rest, _VERTICES))
        self._rotations = rotations
        self._root = surface.joints_rest[0]
        self._points, self._normals = posed_many(few, rotations, np.zeros(surface.num_betas))
        yaws = 2 * np.pi * np.arange(_YAWS) / _YAWS
        self._turns = vector_to_matrix(np.stack([np.zeros(_YAWS), yaws, np.zeros(_YAWS)], 1))

    def placed(self, grid: ScanGrid, betas: Array) -> list[BodyState]:
        """Return the poses that fit a scan best, turned and placed, the best first.

        Args:
            grid: of the scan.
            betas: [S], shape parameters that the states get.
        """
        placed = [self._placed(turn, grid) for turn in self._turns]
        cost = np.stack([each[0] for each in placed])  # [yaws, poses]
        is_best = (cost <= np.roll(cost, 1, 0)) & (cost <= np.roll(cost, -1, 0))  # among neighbouring yaws
        among = np.where(is_best, cost, np.inf)
        leans = self._rotations[:, 0, 1, 1] < _LEANING
        groups = [np.where(group, among, np.inf).argsort(1)[:, :_SCORED] for group in (leans, ~leans)]
        scan = with_normals(grid.scan.points[:_OTHER_SIDE], grid.scan.normals[:_OTHER_SIDE])
        scored = []
        for yaw, pose in [(yaw, pose) for group in groups for yaw, best in enumerate(group) for pose in best]:
            turn, shift = self._turns[yaw], placed[yaw][1][pose]
            body = with_normals(self._points[pose] @ turn.T + shift, self._normals[pose] @ turn.T)
            other_side = np.minimum(np.sqrt(squared_distances(scan, body).min(1)), _CAP_M).mean()
            scored.append((cost[yaw, pose] + other_side, self._state(pose, turn, shift, betas)))
        return [state for _, state in sorted(scored, key=lambda each: each[0])]

    def _placed(self, turn: Array, grid: ScanGrid) -> tuple[Array, Array]:
        """Turn all clouds and move them onto the scan; return their costs [C] and shifts [C, 3], metres."""
        points, normals = self._points @ turn.T, self._normals @ turn.T
        shift = grid.scan.centre - (points.max(1) + points.min(1)) / 2
        for _ in range(_SHIFTS):
            moved = points + shift[:, None]
            away = grid.scan.points[grid.closest(moved)] - moved
            length = np.linalg.norm(away, axis=2, keepdims=True)
            shift = shift + (away * (_CAP_M / np.maximum(length, _CAP_M))).mean(1)
        moved = points + shift[:, None]
        closest = grid.closest(moved)
        places, turned = grid.scan.points[closest] - moved, grid.scan.normals[closest] - normals
        apart = with_normals(places.reshape(-1, 3), turned.reshape(-1, 3))
        return np.minimum(np.linalg.norm(apart, axis=1), _CAP_M).reshape(len(points), -1).mean(1), shift

    def _state(self, pose: int, turn: Array, shift: Array, betas: Array) -> BodyState:
        rotations = self._rotations[pose].copy()
        rotations[0] = turn @ rotations[0]
        # the clouds are turned about the origin, a state about its root
        return BodyState(rotations, shift + turn @ self._root - self._root, betas)
