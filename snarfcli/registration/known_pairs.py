"""Poses of a surface whose points are known in every frame, for many frames at once.

A point moved by linear blend skinning is linear in the bone transforms, and so is the lever about a joint. So the normal
equations of all points follow from three sums over the points: the second moments of the rest points times their weights, which
are the same in all frames, and per frame the moments with the points of that frame. A Gauss-Newton step then costs the same for
any number of points. Pose correctives, which are small, are taken off the points of the frame between the steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.kinematics import kinematics
from snarfcli.registration.rotations import nearest_rotations, project_to_rotations, vector_to_matrix

__all__ = ["KnownPairs", "PairedPoses"]

Array = NDArray[np.float64]

_ROUNDS = 3  # for poses with correctives: these are of the round before; each round leaves a fifth of the error
_STEPS = 2  # per round
_LIKE_PARENT = 1e-5  # squared metres: parts that extend less than 3 mm turn with their parents at first
_DAMPING = 1e-6  # relative to the mean of the diagonal
_LONGEST_TURN_RAD = 0.7
_NUMBERS_AT_ONCE = 4e6  # in the largest array


@dataclass(frozen=True, eq=False)
class PairedPoses:
    """Poses and places of T frames."""

    rotations: Array
    """[T, J, 3, 3], of the joints relative to their parents."""
    translation: Array
    """[T, 3], metres."""
    distances: Array
    """[T, K], from the posed points to those of the frames, metres."""

    def state(self, frame: int, betas: Array) -> BodyState:
        """Return one of the frames, with the shape."""
        return BodyState(self.rotations[frame], self.translation[frame], betas)


class KnownPairs:
    """Finds the poses in which a surface of one shape comes closest to given points.

    Args:
        surface: its K points.
        betas: [S], shape parameters.
        importance: [K], how much each point counts, not negative; equal without it.

    Attributes:
        importance: [K], scaled to a sum of 1.
    """

    def __init__(self, surface: BodySurface, betas: Array, importance: Array | None = None) -> None:
        self._surface = surface
        count = len(surface.points_rest)
        importance = np.ones(count) if importance is None else importance
        self.importance = importance / importance.sum()
        self._joints = surface.rest_joints(betas)
        self._points = surface.points_rest + surface.points_by_beta @ betas
        homogeneous = np.concatenate([self._points, np.ones((count, 1))], 1)
        self._basis = (surface.weights[:, :, None] * homogeneous[:, None]).reshape(count, -1)  # [K, 4 J]
        self._weighted_basis = self.importance[:, None] * self._basis
        self._moments = self._weighted_basis.T @ self._basis  # [4 J, 4 J]
        self._sums = np.tile([0.0, 0.0, 0.0, 1.0], surface.num_joints)  # a basis times this is 1
        squares = self.importance[:, None] * np.square(surface.weights)
        self._parts = squares / np.maximum(squares.sum(0), 1e-12)  # [K, J], points by which the first turn of a joint is found

    @property
    def frames_at_once(self) -> int:
        """Number of frames for which `find` needs little memory."""
        largest = max(12 * self._surface.num_joints**2, 9 * len(self._points))
        return int(np.clip(_NUMBERS_AT_ONCE / largest, 1, 64))

    def find(self, points: Array) -> PairedPoses:
        """Return the poses for the points [T, K, 3] of T frames, metres."""
        rotations = self._first_rotations(points)
        translation = np.zeros((len(points), 3))
        moments = self._moments_with(points)
        translation -= self._offset(rotations, translation, moments)
        has_correctives = self._surface.correctives.shape[2] > 0
        for _ in range(_ROUNDS):
            if has_correctives:
                moments = self._moments_with(points - self._corrections(rotations))
            for _ in range(_STEPS):
                rotations, translation = self._step(rotations, translation, moments)
            rotations = project_to_rotations(rotations)
        apart = self._posed(rotations, translation) + self._corrections(rotations) - points
        return PairedPoses(rotations, translation, np.linalg.norm(apart, axis=2))

    def _first_rotations(self, points: Array) -> Array:
        """Return the rotations [T, J, 3, 3] that turn the part of each joint rigidly (Kabsch 1976)."""
        frames = len(points)
        flat = points.transpose(1, 0, 2).reshape(len(points[0]), -1)
        centres = (self._parts.T @ flat).reshape(-1, frames, 3)
        rest_centres = self._parts.T @ self._points
        spread = np.stack([(self._parts * self._points[:, [axis]]).T @ flat for axis in range(3)], -1)
        spread = spread.reshape(-1, frames, 3, 3) - centres[..., None] * rest_centres[:, None, None]
        turns = np.empty((frames, self._surface.num_joints, 3, 3))
        rotations = np.empty_like(turns)
        for joint, parent in enumerate(self._surface.parents):
            above = turns[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (frames, 3, 3))
            turns[:, joint] = nearest_rotations(spread[joint] + _LIKE_PARENT * above)
            rotations[:, joint] = above.transpose(0, 2, 1) @ turns[:, joint]
        return rotations

    def _step(self, rotations: Array, translation: Array, moments: Array) -> tuple[Array, Array]:
        """Take one Gauss-Newton step; see `_moments_with` for `moments`."""
        surface, frames = self._surface, len(rotations)
        count = 3 * surface.num_joints
        turns, joints, transforms = self._transforms(rotations, translation)
        levers = self._levers(turns, joints, transforms)
        lever_moments = (levers @ self._moments @ levers.transpose(0, 2, 1)).reshape(frames, count // 3, 3, count // 3, 3)
        residuals = (transforms @ self._moments - moments) @ levers.transpose(0, 2, 1)  # [T, 3, 3 J]
        size = count + 3
        system, gradient = np.zeros((frames, size, size)), np.empty((frames, size))
        dots = np.einsum("tkala->tkl", lever_moments)
        blocks = dots[:, :, None, :, None] * np.eye(3)[:, None] - lever_moments.transpose(0, 1, 4, 3, 2)
        system[:, :count, :count] = blocks.reshape(frames, count, count)
        arms = (levers @ (self._moments @ self._sums)).reshape(frames, -1, 3)
        system[:, :count, count:] = _cross_matrices(arms).reshape(frames, count, 3)
        system[:, count:, :count] = system[:, :count, count:].transpose(0, 2, 1)
        system[:, count:, count:] = np.eye(3)
        by_joint = residuals.reshape(frames, 3, -1, 3)
        for axis, (first, second) in enumerate(((1, 2), (2, 0), (0, 1))):  # lever x residual
            gradient[:, axis:count:3] = by_joint[:, second, :, first] - by_joint[:, first, :, second]
        gradient[:, count:] = self._offset_of(transforms, moments)
        diagonal = np.einsum("tii->ti", system)
        diagonal += _DAMPING * diagonal.mean(1, keepdims=True)
        change = -np.linalg.solve(system, gradient[..., None])[..., 0]
        vectors = change[:, :count].reshape(frames, -1, 3)
        vectors *= _LONGEST_TURN_RAD / np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), _LONGEST_TURN_RAD)
        above = np.stack(
            [np.broadcast_to(np.eye(3), (frames, 3, 3)) if parent < 0 else turns[:, parent] for parent in surface.parents], 1
        )
        return above.transpose(0, 1, 3, 2) @ vector_to_matrix(vectors) @ above @ rotations, translation + change[:, count:]

    def _transforms(self, rotations: Array, translation: Array) -> tuple[Array, Array, Array]:
        """Return turns [T, J, 3, 3], joints [T, J, 3] and bone transforms [T, 3, 4 J] of poses, metres."""
        rest = self._joints
        turns, joints = kinematics(self._surface.parents, rest, rotations)
        joints += translation[:, None]
        shifts = joints - (turns @ rest[..., None])[..., 0]
        transforms = np.concatenate([turns, shifts[..., None]], 3)
        return turns, joints, transforms.transpose(0, 2, 1, 3).reshape(len(turns), 3, -1)

    def _levers(self, turns: Array, joints: Array, transforms: Array) -> Array:
        """Return the matrices [T, 3 J, 4 J] that turn the basis of a point into its levers about all joints."""
        frames, count = joints.shape[:2]
        levers = np.empty((frames, count, 3, count, 4))
        by_bone = transforms.reshape(frames, 3, count, 4)
        follows = self._surface.follows.T[:, None]  # [J of the turn, 1, J of the bone]
        levers[..., :3] = follows[..., None] * by_bone[:, None, ..., :3]
        levers[..., 3] = follows * (by_bone[:, None, ..., 3] - joints[..., None])
        return levers.reshape(frames, 3 * count, 4 * count)

    def _moments_with(self, points: Array) -> Array:
        """Return the moments [T, 3, 4 J] of points [T, K, 3] with the basis."""
        return points.transpose(0, 2, 1) @ self._weighted_basis

    def _offset(self, rotations: Array, translation: Array, moments: Array) -> Array:
        """Return the mean offset [T, 3] from the points of the frames to the posed points, metres."""
        return self._offset_of(self._transforms(rotations, translation)[2], moments)

    def _offset_of(self, transforms: Array, moments: Array) -> Array:
        return (transforms @ self._moments - moments) @ self._sums

    def _posed(self, rotations: Array, translation: Array) -> Array:
        """Return the points [T, K, 3] in poses, without pose correctives, metres."""
        transforms = self._transforms(rotations, translation)[2]
        return (self._basis @ transforms.transpose(0, 2, 1)).reshape(len(rotations), -1, 3)

    def _corrections(self, rotations: Array) -> Array:
        """Return the offsets [T, K, 3] of the posed points by the pose correctives, metres."""
        surface, frames = self._surface, len(rotations)
        if not surface.correctives.shape[2]:
            return np.zeros((frames, len(self._points), 3))
        features = (rotations[:, 1:] - np.eye(3)).reshape(frames, -1)
        offsets = features @ surface.correctives.reshape(-1, features.shape[1]).T
        turns = self._transforms(rotations, np.zeros((frames, 3)))[0]
        blended = (surface.weights @ turns.reshape(frames, -1, 9)).reshape(frames, -1, 3, 3)
        return (blended @ offsets.reshape(frames, -1, 3, 1))[..., 0]


def _cross_matrices(vectors: Array) -> Array:
    """Return the matrices [..., 3, 3] that multiply a vector like the cross product with `vectors` from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vectors.shape, 3)
