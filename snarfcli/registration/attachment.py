"""Vertices of a scan that follow a body, and the shape and offsets with which they do so in several frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.meshing.mesh import vertex_normals
from snarfcli.registration.body_surface import BodyState, BodySurface, PosedSurface, farthest_points
from snarfcli.registration.scan_points import with_normals

__all__ = ["AttachedPoints", "attach", "refine", "with_mean_offsets"]

Array = NDArray[np.float64]

_PER_POINT = ("points_rest", "points_by_beta", "normals_rest", "weights", "correctives")
_SPREAD_FROM = 20_000  # vertices, of which those to attach are chosen
_NEIGHBOURS = 4  # vertices of the body that a vertex of the scan follows
_NEAR_M = 0.01  # neighbours that are closer than this count about alike
_NOISE_M = 0.003  # by which points leave the places to which skinning moves them
_SHORTEST_OFFSET_M, _LONGEST_OFFSET_M = 0.003, 0.01  # about how long offsets are, without clothes
_PINNED = 1e3  # weight of offsets that are none
_MOVING_M = 0.005  # a point that moves so far against the body counts a quarter, or of three times the median if that is more
_LEAST_VOLUME = 0.3  # a point that skinning squeezes to less than this share in some frame says less about the others,
_LEAST_USABLE = 0.05  # but at least so much, or a joint that only moves such points would be free
_REGULAR = 1e-3  # of the inverse of the skinning, which is singular at some points of a part that is turned by 180 degrees
_STEPS = 12
_LEAST_GAIN = 1e-8  # squared metres; no more steps are taken after one of less
_POINTS = 600  # that take part in the joint steps; the offsets of all follow
_SHAPE_PRIOR = 1e-6  # as in the solver
_DAMPING = 1e-5  # relative to the mean of the diagonal
_LONGEST_TURN_RAD, _LONGEST_SHIFT_M, _LONGEST_BETA = 0.35, 0.2, 1.0  # in one step


@dataclass(frozen=True, eq=False)
class AttachedPoints:
    """K vertices of a scan as points of a body."""

    surface: BodySurface
    """The points as if they were vertices of the body; `vertex_numbers` are those in the scan."""
    offsets: Array
    """[K, 3], from the skin of the body to the points, metres, part of `surface.points_rest`."""
    importance: Array
    """[K], from 0 to 1; low for points that do not move as the body does."""

    @classmethod
    def own(cls, surface: BodySurface, count: int) -> AttachedPoints:
        """Return `count` vertices of the body itself, which a scan of the body's own topology has."""
        chosen = farthest_points(surface.points_rest, count)
        return cls(surface.take(chosen), np.zeros((len(chosen), 3)), np.ones(len(chosen)))

    def first(self, count: int) -> AttachedPoints:
        """Return the first of the points, which are spread evenly like all."""
        some = np.arange(min(count, len(self.offsets)))
        return AttachedPoints(self.surface.take(some), self.offsets[some], self.importance[some])

    def moved(self, offsets: Array, importance: Array) -> AttachedPoints:
        """Return the points with other offsets and importance."""
        points = self.surface.points_rest + offsets - self.offsets
        return AttachedPoints(replace(self.surface, points_rest=points), offsets, importance)


def attach(
    surface: BodySurface, states: Sequence[BodyState], frames: Sequence[Array] | Array, faces: NDArray, count: int
) -> AttachedPoints:
    """Attach vertices of a scan to a body, each in the frame in which it is closest to the body.

    Args:
        surface: all vertices of the body.
        states: of the body in A frames.
        frames: the vertices [V, 3] of the scan in these frames, metres.
        faces: [F, 3] of the scan; normals that point inwards are noticed.
        count: number of vertices to attach, spread evenly.
    """
    used = np.unique(faces)
    if len(used) > _SPREAD_FROM:
        used = np.random.default_rng(0).permutation(used)[:_SPREAD_FROM]
    chosen = used[farthest_points(frames[0][used], count)]
    best, found = np.full(len(chosen), np.inf), None
    for state, vertices in zip(states, frames, strict=True):
        distance, candidate = _attach_in_frame(surface, state, vertices, faces, chosen)
        found = candidate if found is None else _better(found, candidate, distance < best)
        best = np.minimum(best, distance)
    assert found is not None  # there is at least one frame
    return found


def _attach_in_frame(
    surface: BodySurface, state: BodyState, vertices: Array, faces: NDArray, chosen: NDArray[np.intp]
) -> tuple[Array, AttachedPoints]:
    """Return the distances [K] of the vertices to the body by place and normal, and the attached points."""
    posed = surface.posed(state)
    normals = vertex_normals(vertices, faces)[chosen].astype(np.float64)
    tree = KDTree(with_normals(posed.points, posed.normals))
    facing = [with_normals(vertices[chosen], sign * normals) for sign in (1.0, -1.0)]
    features = min(facing, key=lambda features: tree.query(features)[0].sum())
    distances, attached = _interpolated(surface, tree, features)
    blended, _ = _blended(attached, posed)
    turned = (blended.transpose(0, 2, 1) @ features[:, 3:, None])[..., 0]
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
    attached = replace(attached, normals_rest=turned, vertex_numbers=chosen)
    offsets = unposed(attached, state, vertices[chosen])[0] - attached.points_rest
    start = AttachedPoints(attached, np.zeros_like(offsets), np.ones(len(chosen)))
    return distances, start.moved(offsets, start.importance)


def _interpolated(surface: BodySurface, tree: KDTree, features: Array) -> tuple[Array, BodySurface]:
    """Return the distances [K] of points to the vertices of a body, and the body between the vertices nearest to each.

    Args:
        surface: the body.
        tree: of the places and scaled normals of its vertices, in any pose.
        features: [K, 6], those of the points in this pose.
    """
    found = tree.query(features, min(_NEIGHBOURS, tree.n))
    distances, near = (np.asarray(part).reshape(len(features), -1) for part in found)  # [K, 4]
    share = 1 / (np.square(distances) + _NEAR_M**2)
    share /= share.sum(1, keepdims=True)
    mixed = {name: np.einsum("kn,kn...->k...", share, getattr(surface, name)[near]) for name in _PER_POINT}
    return distances[:, 0], replace(surface, **mixed, vertex_numbers=near[:, 0])


def _attached_again(surface: BodySurface, attached: AttachedPoints, betas: Array) -> AttachedPoints:
    """Return the points attached to those parts of the body that are nearest in the rest pose of a shape."""
    points = attached.surface.points_rest + attached.surface.points_by_beta @ betas
    tree = KDTree(with_normals(surface.points_rest + surface.points_by_beta @ betas, surface.normals_rest))
    _, nearest = _interpolated(surface, tree, with_normals(points, attached.surface.normals_rest))
    points = points - nearest.points_by_beta @ betas
    kept = {name: getattr(attached.surface, name) for name in ("normals_rest", "vertex_numbers")}
    again = replace(nearest, points_rest=points, **kept)
    return AttachedPoints(again, points - nearest.points_rest, attached.importance)


def _better(first: AttachedPoints, second: AttachedPoints, is_second: NDArray[np.bool_]) -> AttachedPoints:
    """Return the points of `second` where `is_second` [K], and of `first` elsewhere."""
    mixed = {}
    for name in _PER_POINT:
        one, other = getattr(first.surface, name), getattr(second.surface, name)
        mixed[name] = np.where(is_second.reshape(-1, *[1] * (one.ndim - 1)), other, one)
    offsets = np.where(is_second[:, None], second.offsets, first.offsets)
    return AttachedPoints(replace(first.surface, **mixed), offsets, first.importance)


def unposed(surface: BodySurface, state: BodyState, points: Array) -> tuple[Array, Array]:
    """Move posed points back to the rest pose of the mean shape.

    Args:
        surface: K points of the body, whose weights count.
        state: of the body.
        points: [K, 3], metres.

    Returns:
        points: [K, 3], metres, without pose correctives and shape.
        volumes: [K], by which the skinning of a point scales space, 1 for a rotation.
    """
    posed = surface.posed(state)
    blended, back = _blended(surface, posed)
    rest = surface.points_rest + (back @ (points - posed.points)[..., None])[..., 0]
    return rest, np.linalg.det(blended)


def _blended(surface: BodySurface, posed: PosedSurface) -> tuple[Array, Array]:
    """Return the matrices [K, 3, 3] with which skinning moves the points, and their regular inverses."""
    blended = (surface.weights @ posed.turns.reshape(-1, 9)).reshape(-1, 3, 3)
    across = blended.transpose(0, 2, 1)
    return blended, np.linalg.solve(across @ blended + _REGULAR * np.eye(3), across)


def refine(
    attached: AttachedPoints,
    states: Sequence[BodyState],
    frames: Array,
    body: BodySurface | None,
    *,
    shape_is_free: bool,
    clothes_m: float = 0.0,
) -> tuple[AttachedPoints, list[BodyState]]:
    """Improve the offsets, the poses and the shape of a body from how the points move from frame to frame.

    Each point has one offset in all frames. The Gauss-Newton steps change the poses of all frames and the shape such that the
    spread of each point about its mean in the rest pose shrinks, which is least where the joints are those about which the
    parts really turn. Offsets cost a little, so that the body stays inside its skin.

    Args:
        attached: the points, of one shape.
        states: of T frames.
        frames: [T, K, 3], the points in these frames, metres.
        body: all its vertices, to which the points are attached anew after each step; None for points that are vertices of the
            body and have no offsets.
        shape_is_free: change the shape parameters, too.
        clothes_m: by how much the points may be outside the body, metres.
    """
    states = list(states)
    offset_weight = _PINNED if body is None else np.square(_NOISE_M / (_LONGEST_OFFSET_M + clothes_m))
    attached = with_mean_offsets(attached, states, frames, offset_weight)
    for _ in range(_STEPS):
        states, gain = _joint_step(attached.first(_POINTS), states, frames[:, :_POINTS], offset_weight, shape_is_free)
        if body is not None:
            attached = _attached_again(body, attached, states[0].betas)
            usual = float(np.median(np.linalg.norm(attached.offsets, axis=1)))
            usual = min(max(usual, _SHORTEST_OFFSET_M + clothes_m), _LONGEST_OFFSET_M + clothes_m)
            offset_weight = np.square(_NOISE_M / usual)
        attached = with_mean_offsets(attached, states, frames, offset_weight)
        if gain < _LEAST_GAIN:
            break
    return attached, states


def with_mean_offsets(
    attached: AttachedPoints, states: Sequence[BodyState], frames: Sequence[Array] | Array, offset_weight: float
) -> AttachedPoints:
    """Return the points with the mean of their offsets in T frames, and with new importance.

    Args:
        attached: the points.
        states: of the body in these frames.
        frames: [T, K, 3], the points in these frames, metres.
        offset_weight: number of additional frames in which the offsets are 0, which draw them to 0.
    """
    pairs = [unposed(attached.surface, state, points) for state, points in zip(states, frames, strict=True)]
    offsets = np.stack([rest for rest, _ in pairs]) - (attached.surface.points_rest - attached.offsets)
    mean = offsets.sum(0) / (len(frames) + offset_weight)
    moving = np.sqrt(np.square(offsets - mean).sum(2).mean(0))
    scale = max(_MOVING_M, 3 * float(np.median(moving)))
    volume = np.stack([volume for _, volume in pairs]).min(0)
    usable = np.clip(volume / _LEAST_VOLUME, _LEAST_USABLE, 1.0)
    return attached.moved(mean, usable / np.square(1 + np.square(moving / scale)))


def _joint_step(
    attached: AttachedPoints, states: list[BodyState], frames: Array, offset_weight: float, shape_is_free: bool
) -> tuple[list[BodyState], float]:
    """Take one Gauss-Newton step of all poses and the shape; the offsets, which follow from them, are eliminated.

    Returns:
        The states, and by how much the mean of the squared distances should shrink by the step, doubled, squared metres.
    """
    surface = attached.surface
    turns, count = 3 * surface.num_joints, 3 * surface.num_joints + 3
    betas = surface.num_betas if shape_is_free else 0
    size = len(states) * count + betas
    root = np.sqrt(attached.importance / max(attached.importance.sum(), 1e-12))[:, None]
    system, gradient = np.zeros((size, size)), np.zeros(size)
    total, offset = np.zeros((attached.offsets.size, size)), offset_weight * (root * attached.offsets).reshape(-1)
    shape = slice(len(states) * count, size)
    posed_frames = []
    for number, (state, points) in enumerate(zip(states, frames, strict=True)):
        posed, derivatives = surface.posed_with_derivatives(state)
        posed_frames.append(posed)
        back = root[..., None] * _blended(surface, posed)[1]
        rows = (back @ derivatives.rows(np.arange(len(points)))[:, :, : count + betas]).reshape(-1, count + betas)
        residual = (back @ (posed.points - points)[..., None]).reshape(-1)
        place = np.concatenate([np.arange(number * count, (number + 1) * count), np.arange(shape.start, size)])
        system[np.ix_(place, place)] += rows.T @ rows
        gradient[place] += rows.T @ residual
        total[:, place] += rows
        offset += residual
    system -= total.T @ total / (len(states) + offset_weight)
    gradient -= total.T @ offset / (len(states) + offset_weight)
    system[shape, shape] += _SHAPE_PRIOR * np.eye(betas)
    gradient[shape] += _SHAPE_PRIOR * states[0].betas[:betas]
    system[np.diag_indices(size)] += _DAMPING * np.trace(system) / size
    change = -np.linalg.solve(system, gradient)
    new_betas = states[0].betas.copy()
    new_betas[:betas] += np.clip(change[shape], -_LONGEST_BETA, _LONGEST_BETA)
    by_frame = change[: shape.start].reshape(len(states), count)
    by_frame[:, :turns] = np.clip(by_frame[:, :turns], -_LONGEST_TURN_RAD, _LONGEST_TURN_RAD)
    by_frame[:, turns:] = np.clip(by_frame[:, turns:], -_LONGEST_SHIFT_M, _LONGEST_SHIFT_M)
    moved = []
    for state, posed, own in zip(states, posed_frames, by_frame, strict=True):
        turned = surface.turned(state, posed, own[:turns].reshape(-1, 3))
        moved.append(BodyState(turned, state.translation + own[turns:], new_betas))
    return moved, float(-gradient @ change) / len(states)
