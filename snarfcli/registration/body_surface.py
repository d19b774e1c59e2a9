"""The posed surface of a body at some of its vertices, and how it moves with pose, place and shape, in closed form.

NumPy, float64, metres. Everything that changes with the pose is derived by turns of joints about the axes of the posed frame: a
turn w of joint k moves a point by w x a, with a the lever of the point's share that follows the joint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from snarfcli.bodies import Body, Skeleton
from snarfcli.meshing.mesh import vertex_normals
from snarfcli.point_clouds import LEAST_POINTS, point_areas
from snarfcli.registration.kinematics import kinematics
from snarfcli.registration.rotations import matrix_to_vector, project_to_rotations, vector_to_matrix

__all__ = ["BodyState", "BodySurface", "PosedSurface", "SurfaceDerivatives", "farthest_points"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BodyState:
    """Pose, place and shape of a body."""

    rotations: Array
    """[J, 3, 3], rotations of the joints relative to their parents, in the axes of the rest pose."""
    translation: Array
    """[3], metres."""
    betas: Array
    """[S], shape parameters."""

    @classmethod
    def from_pose(cls, pose: Array, translation: Array, betas: Array) -> BodyState:
        """Return the state of a pose [J, 3], axis-angle, radians."""
        return cls(vector_to_matrix(pose), np.asarray(translation, np.float64), np.asarray(betas, np.float64))

    @property
    def pose(self) -> Array:
        """[J, 3], axis-angle, radians."""
        return matrix_to_vector(self.rotations)


@dataclass(frozen=True)
class PosedSurface:
    """A surface in one state."""

    points: Array
    """[K, 3], metres."""
    normals: Array
    """[K, 3], unit length, outward."""
    turns: Array
    """[J, 3, 3], rotations of the joints from the rest pose to the posed frame."""
    joints: Array
    """[J, 3], metres."""


@dataclass(frozen=True)
class SurfaceDerivatives:
    """How the points of a posed surface move."""

    levers: Array
    """[K, J, 3]: a turn w of joint k, radians in the axes of the posed frame, moves a point by w x lever."""
    by_beta: Array
    """[K, 3, S], metres per unit of each shape parameter."""

    def rows(self, index: NDArray[np.intp]) -> Array:
        """Return the derivatives of chosen points, [M, 3, 3 J + 3 + S]: by turns, by translation, by shape."""
        levers, by_beta = self.levers[index], self.by_beta[index]
        count, joints = levers.shape[:2]
        rows = np.zeros((count, 3, 3 * joints + 3 + by_beta.shape[2]))
        turns = rows[:, :, : 3 * joints].reshape(count, 3, joints, 3)
        x, y, z = levers[..., 0], levers[..., 1], levers[..., 2]
        turns[:, 0, :, 1], turns[:, 0, :, 2] = z, -y  # w x a, one row per coordinate
        turns[:, 1, :, 2], turns[:, 1, :, 0] = x, -z
        turns[:, 2, :, 0], turns[:, 2, :, 1] = y, -x
        rows[:, :, 3 * joints : 3 * joints + 3] = np.eye(3)
        rows[:, :, 3 * joints + 3 :] = by_beta
        return rows

    def normal_equations(self, weights: Array, pulls: Array) -> tuple[Array, Array]:
        """Return the sums over all points of d^T W d, [D, D], and d^T p, [D]; d [3, D]: the rows of a point, D = 3 J + 3 + S.

        Args:
            weights: [K, 3, 3], W of each point, symmetric and positive definite.
            pulls: [K, 3], p of each point.
        """
        joints = self.levers.shape[1]
        roots = np.linalg.cholesky(weights).transpose(0, 2, 1)  # W = R^T R; rows of R d, by r (w x a) = w (a x r)
        x, y, z = (self.levers[:, None, :, axis] for axis in range(3))
        along_x, along_y, along_z = (roots[:, :, None, axis] for axis in range(3))
        rows = np.empty((len(roots), 3, 3 * joints + 3 + self.by_beta.shape[2]))
        turns = rows[:, :, : 3 * joints].reshape(len(roots), 3, joints, 3)
        turns[..., 0] = y * along_z - z * along_y
        turns[..., 1] = z * along_x - x * along_z
        turns[..., 2] = x * along_y - y * along_x
        rows[:, :, 3 * joints : 3 * joints + 3] = roots
        rows[:, :, 3 * joints + 3 :] = roots @ self.by_beta
        flat = rows.reshape(-1, rows.shape[2])
        moments = np.tensordot(self.levers, pulls, ((0,), (0,)))  # [J, 3, 3], sums of a p^T
        by_turns = np.stack([moments[:, a, b] - moments[:, b, a] for a, b in ((1, 2), (2, 0), (0, 1))], 1)
        by_beta = np.tensordot(self.by_beta, pulls, ((0, 1), (0, 1)))
        return flat.T @ flat, np.concatenate([by_turns.reshape(-1), pulls.sum(0), by_beta])


@dataclass(frozen=True, eq=False)
class BodySurface:
    """K vertices of a body in its rest pose, with all that moves them."""

    joint_names: tuple[str, ...]
    """J joint names."""
    parents: tuple[int, ...]
    """J parents, -1 for the root; a parent comes before its children."""
    joints_rest: Array
    """[J, 3], joints of the mean shape in the rest pose, metres."""
    joints_by_beta: Array
    """[J, 3, S], metres per unit of each shape parameter."""
    points_rest: Array
    """[K, 3], vertices of the mean shape in the rest pose, metres."""
    points_by_beta: Array
    """[K, 3, S], metres per unit of each shape parameter."""
    normals_rest: Array
    """[K, 3], unit length, outward, of the mean shape."""
    weights: Array
    """[K, J], skinning weights, rows sum to 1."""
    correctives: Array
    """[K, 3, 9 (J - 1)], offsets per entry of R_j - I; [K, 3, 0] without pose correctives."""
    vertex_numbers: NDArray[np.intp]
    """[K], numbers of the vertices in the body."""

    @classmethod
    def from_body(cls, body: Body, count: int, *, betas: int | None = None) -> BodySurface:
        """Return `count` vertices of an SMPL-format body, spread evenly (farthest points).

        Args:
            body: the body, any dtype.
            count: K, number of vertices; all if the body has fewer.
            betas: number of shape parameters to use; all of the body without it.
        """
        template, weights = _numpy(body.v_template), _numpy(body.weights)
        shapedirs = _numpy(body.shapedirs)[..., :betas]
        regressor = _numpy(body.joint_regressor)
        chosen = farthest_points(template, count)
        return cls(
            body.joint_names,
            body.parents,
            regressor @ template,
            np.einsum("jv,vcs->jcs", regressor, shapedirs),
            template[chosen],
            shapedirs[chosen],
            vertex_normals(template, body.faces.cpu().numpy())[chosen].astype(np.float64),
            weights[chosen],
            _numpy(body.posedirs)[chosen],
            chosen,
        )

    @classmethod
    def from_rig(cls, skeleton: Skeleton, vertices: Array, faces: NDArray, weights: Array, count: int) -> BodySurface:
        """Return `count` vertices of a rigged mesh in its rest pose, which has no shape parameters.

        Args:
            skeleton: joint tree with the joints in the rest pose.
            vertices: [V, 3], rest pose, metres.
            faces: [F, 3], outward.
            weights: [V, J], rows sum to 1.
            count: K, number of vertices; all if there are fewer.
        """
        chosen = farthest_points(vertices, count)
        joints = _numpy(skeleton.joints_rest)
        return cls(
            skeleton.names,
            skeleton.parents,
            joints,
            np.zeros((len(joints), 3, 0)),
            np.asarray(vertices, np.float64)[chosen],
            np.zeros((len(chosen), 3, 0)),
            vertex_normals(vertices, faces)[chosen].astype(np.float64),
            np.asarray(weights, np.float64)[chosen],
            np.zeros((len(chosen), 3, 0)),
            chosen,
        )

    @cached_property
    def follows(self) -> Array:
        """[J, J], 1 where bone j (row) is joint k (column) or follows it, 0 elsewhere."""
        follows = np.eye(self.num_joints)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                follows[joint] += follows[parent]
        return follows

    @cached_property
    def bones(self) -> NDArray[np.intp]:
        """[K], the joint that moves each point most."""
        return self.weights.argmax(1)

    @cached_property
    def bone_areas(self) -> Array:
        """[J], share of the surface in the rest pose that moves with each joint and those that follow it."""
        few = len(self.points_rest) < LEAST_POINTS
        areas = np.ones(len(self.points_rest)) if few else point_areas(self.points_rest)
        return np.bincount(self.bones, areas, self.num_joints) @ self.follows / areas.sum()

    @cached_property
    def shares(self) -> Array:
        """[K, J], share of each point that follows a joint."""
        return self.weights @ self.follows

    @property
    def num_joints(self) -> int:
        """J, the number of joints."""
        return len(self.parents)

    @property
    def num_betas(self) -> int:
        """S, the number of shape parameters."""
        return self.points_by_beta.shape[2]

    def take(self, index: NDArray) -> BodySurface:
        """Return the surface with fewer of its points."""
        names = ("points_rest", "points_by_beta", "normals_rest", "weights", "correctives", "vertex_numbers")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def rest_joints(self, betas: Array) -> Array:
        """Return the joints [J, 3] of one shape in the rest pose, metres."""
        return self.joints_rest + self.joints_by_beta @ betas

    def joints(self, state: BodyState) -> Array:
        """Return the joints [J, 3] in a state, metres."""
        return self._kinematics(state)[1]

    def posed(self, state: BodyState) -> PosedSurface:
        """Return the surface in a state (SMPL Eq. 2, 5 and 6; linear blend skinning)."""
        return self._posed(state)[0]

    def posed_with_derivatives(self, state: BodyState) -> tuple[PosedSurface, SurfaceDerivatives]:
        """Return the surface in a state, and how its points move; the change of the pose correctives is left out."""
        surface, rest, blended, shifts = self._posed(state)
        moved = np.einsum("jab,kb->kaj", surface.turns, rest) + shifts.T
        levers = (self.weights[:, None] * moved) @ self.follows - self.shares[:, None] * surface.joints.T
        by_beta = blended @ self.points_by_beta
        if self.num_betas:
            joints = self.joints_by_beta
            posed = np.empty_like(joints)
            for joint, parent in enumerate(self.parents):
                placed = joints[joint] if parent < 0 else surface.turns[parent] @ (joints[joint] - joints[parent])
                posed[joint] = placed if parent < 0 else posed[parent] + placed
            by_beta += np.einsum("kj,jcs->kcs", self.weights, posed - surface.turns @ joints)
        return surface, SurfaceDerivatives(levers.transpose(0, 2, 1), by_beta)

    def turned(self, state: BodyState, surface: PosedSurface, turns: Array) -> Array:
        """Return the rotations [J, 3, 3] of a state after turns [J, 3] of its joints, radians, in the axes of the posed frame.

        Args:
            state: before.
            surface: posed in this state.
            turns: about each joint, of all that follows it.
        """
        above = np.stack([np.eye(3) if parent < 0 else surface.turns[parent] for parent in self.parents])
        return project_to_rotations(above.transpose(0, 2, 1) @ vector_to_matrix(turns) @ above @ state.rotations)

    def _kinematics(self, state: BodyState) -> tuple[Array, Array]:
        """Return the rotations [J, 3, 3] from the rest pose, and the joints [J, 3], metres."""
        turns, joints = kinematics(self.parents, self.rest_joints(state.betas), state.rotations[None])
        return turns[0], joints[0] + state.translation

    def _posed(self, state: BodyState) -> tuple[PosedSurface, Array, Array, Array]:
        """Return the posed surface, its rest points with correctives, the blended rotations, and the joints' shifts [J, 3]."""
        turns, joints = self._kinematics(state)
        rest = self.points_rest + self.points_by_beta @ state.betas
        if self.correctives.shape[2]:
            rest = rest + self.correctives @ (state.rotations[1:] - np.eye(3)).reshape(-1)
        shifts = joints - (turns @ self.rest_joints(state.betas)[..., None])[..., 0]
        blended = (self.weights @ turns.reshape(-1, 9)).reshape(-1, 3, 3)
        points = (blended @ rest[..., None])[..., 0] + self.weights @ shifts
        normals = (blended @ self.normals_rest[..., None])[..., 0]
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return PosedSurface(points, normals, turns, joints), rest, blended, shifts


def farthest_points(points: Array, count: int) -> NDArray[np.intp]:
    """Return the numbers of `count` points [K], each as far as possible from those before; all if there are fewer."""
    if count >= len(points):
        return np.arange(len(points))
    chosen = np.zeros(count, np.intp)
    distance = np.full(len(points), np.inf)
    for number in range(1, count):
        distance = np.minimum(distance, np.square(points - points[chosen[number - 1]]).sum(1))
        chosen[number] = distance.argmax()
    return chosen


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy().astype(np.float64)
