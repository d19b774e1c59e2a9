"""Search for single limbs that lie wrong while the rest of a body lies right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snarfcli.registration.body_surface import BodyState, BodySurface, PosedSurface, farthest_points
from snarfcli.registration.kinematics import kinematics
from snarfcli.registration.matches import Agreement
from snarfcli.registration.scan_grid import ScanGrid
from snarfcli.registration.scan_points import with_normals

__all__ = ["Limb", "doubtful_limbs", "find_limbs", "limb_candidates", "squared_distances"]

Array = NDArray[np.float64]

_POSES = 250  # of each limb, each as far as possible from those before
_LEAST_SHARE = 0.04  # of the vertices, that a limb has; the tip of a tail or a finger is no limb of its own
_SCORED_VERTICES = 50  # of a limb
_SCAN_POINTS = 500  # of the scan, that limbs are scored with
_ROBUST_M = 0.08  # distance that counts half of the most, when limbs are scored
_EXPLAINED_M = 0.03  # a point this close to the rest of the body does not need the limb
_APART_M = 0.08  # mean distance between the vertices of candidates that differ
_FAR_M = 0.06  # a vertex or a point of the scan this far from its match has none
_MOST_FAR = 0.1  # share of a limb's vertices
_MOST_OPEN = 0.015  # share of the points of the scan


@dataclass(frozen=True, eq=False)
class Limb:
    """A joint that branches off with all that follows it, and poses of them."""

    joints: NDArray[np.intp]
    """Joints of the limb; a parent comes before its children."""
    vertices: NDArray[np.intp]
    """Vertices of the surface that follow the limb."""
    rotations: Array
    """[C, joints, 3, 3], poses."""


def find_limbs(surface: BodySurface, library: Array, by_chance: Array | None) -> list[Limb]:
    """Return the limbs of a body: of a person arms, legs, the head and the upper body, and then forearms and lower legs.

    Args:
        surface: the body.
        library: [L, J, 3, 3], known poses.
        by_chance: [L, J, 3, 3], poses inside the limits of the joints, for limbs without branches.
    """
    children = [
        [child for child in _children(surface, joint) if _is_large(surface, child)] for joint in range(surface.num_joints)
    ]
    whole, halves = [], []
    for parent in range(surface.num_joints):
        for first in children[parent] if len(children[parent]) > 1 else ():
            joints = np.flatnonzero(surface.follows[:, first])
            if any(len(children[joint]) > 1 for joint in joints):
                whole.append(_limb(surface, first, library))
                continue
            poses = library if by_chance is None else np.concatenate([library, by_chance])
            whole.append(_limb(surface, first, poses))
            middle = _middle(surface, first)
            if middle != first and _is_large(surface, middle):
                halves.append(_limb(surface, middle, poses))
    return whole + halves


def doubtful_limbs(surface: BodySurface, limbs: Sequence[Limb], found: Agreement) -> list[Limb]:
    """Return the limbs that may lie wrong: all where points of the scan are far from the body, else those far from the scan."""
    if (found.of_scan > _FAR_M).mean() > _MOST_OPEN:
        return list(limbs)
    is_far = found.of_body > _FAR_M
    return [limb for limb in limbs if is_far[surface.shares[:, limb.joints[0]] > 0.5].mean() > _MOST_FAR]


def limb_candidates(
    surface: BodySurface, state: BodyState, limb: Limb, grid: ScanGrid, count: int, most_cost: float = 1.0
) -> list[BodyState]:
    """Return states in which a limb takes other poses that explain the scan better, the best first, each unlike those before.

    Args:
        surface: the body that the limb is of.
        state: where it is.
        limb: the limb.
        grid: of the scan.
        count: the most states.
        most_cost: of a pose, relative to the cost of the pose that the limb has.
    """
    posed = surface.posed(state)
    rotations = np.concatenate([limb.rotations, state.rotations[None, limb.joints]])
    points, normals = _posed_limb(surface, state, posed, limb, rotations)
    closest = grid.closest(points)
    scan = grid.scan
    cost = _robust(np.square(scan.points[closest] - points).sum(2) + _normals_apart(scan.normals[closest], normals)).sum(1)
    cost *= len(limb.vertices) / points.shape[1] / len(surface.weights)
    wanted = with_normals(scan.points[:_SCAN_POINTS], scan.normals[:_SCAN_POINTS])
    rest = np.ones(len(surface.weights), bool)
    rest[limb.vertices] = False
    of_rest = squared_distances(wanted, with_normals(posed.points, posed.normals)[rest]).min(1)
    is_open = of_rest > _EXPLAINED_M**2
    if is_open.any():
        body = with_normals(points.reshape(-1, 3), normals.reshape(-1, 3))
        of_limb = squared_distances(wanted[is_open], body).reshape(is_open.sum(), *points.shape[:2]).min(2)
        cost += _robust(np.minimum(of_limb, of_rest[is_open, None])).sum(0) / len(wanted)
    chosen: list[int] = []
    for number in np.argsort(cost[:-1]):
        if len(chosen) == count or cost[number] >= most_cost * cost[-1]:
            break
        if all(np.linalg.norm(points[number] - points[other], axis=1).mean() > _APART_M for other in chosen):
            chosen.append(int(number))
    return [_with_limb(state, limb, number) for number in chosen]


def squared_distances(one: Array, other: Array) -> Array:
    """Return the squared distances [N, M] between points [N, D] and [M, D]."""
    return np.maximum(np.square(one).sum(1)[:, None] + np.square(other).sum(1) - 2 * one @ other.T, 0.0)


def _with_limb(state: BodyState, limb: Limb, number: int) -> BodyState:
    rotations = state.rotations.copy()
    rotations[limb.joints] = limb.rotations[number]
    return replace(state, rotations=rotations)


def _limb(surface: BodySurface, first: int, poses: Array) -> Limb:
    joints = np.flatnonzero(surface.follows[:, first])
    return Limb(joints, np.flatnonzero(surface.shares[:, first] > 0.5), _spread(surface, joints, poses))


def _children(surface: BodySurface, joint: int) -> list[int]:
    return [child for child, parent in enumerate(surface.parents) if parent == joint]


def _is_large(surface: BodySurface, joint: int) -> bool:
    return bool((surface.shares[:, joint] > 0.5).mean() >= _LEAST_SHARE)


def _middle(surface: BodySurface, first: int) -> int:
    """Return the joint that is closest to half of the way from a joint to the end of its limb, such as an elbow."""
    chain = [first]
    while children := _children(surface, chain[-1]):
        chain.append(max(children, key=lambda child: surface.shares[:, child].sum()))
    along = np.append(0.0, np.linalg.norm(np.diff(surface.joints_rest[chain], axis=0), axis=1).cumsum())
    return chain[int(np.abs(along - along[-1] / 2).argmin())]


def _spread(surface: BodySurface, joints: NDArray[np.intp], poses: Array) -> Array:
    """Return the rotations of a limb's joints in the poses in which they lie as differently as possible."""
    turns, places = kinematics(surface.parents, surface.joints_rest, poses)
    above = surface.parents[joints[0]]
    seen = (places[:, joints] - places[:, above, None]) @ turns[:, above]  # from the joint above, in its axes
    return poses[farthest_points(seen.reshape(len(poses), -1), _POSES)][:, joints]


def _posed_limb(
    surface: BodySurface, state: BodyState, posed: PosedSurface, limb: Limb, rotations: Array
) -> tuple[Array, Array]:
    """Return points and normals [C, vertices, 3] of the limb's vertices in its poses, without pose correctives."""
    rest = surface.rest_joints(state.betas)
    turns, places = dict(enumerate(posed.turns)), dict(enumerate(posed.joints))
    for number, joint in enumerate(limb.joints):
        parent = surface.parents[joint]
        turns[joint] = turns[parent] @ rotations[:, number]
        places[joint] = places[parent] + turns[parent] @ (rest[joint] - rest[parent])
    count = len(rotations)
    few = surface.take(limb.vertices[:_SCORED_VERTICES])
    all_turns = np.stack([np.broadcast_to(turns[joint], (count, 3, 3)) for joint in range(surface.num_joints)], 1)
    all_places = np.stack([np.broadcast_to(places[joint], (count, 3)) for joint in range(surface.num_joints)], 1)
    blended = (few.weights @ all_turns.reshape(count, -1, 9)).reshape(count, -1, 3, 3)
    shifts = all_places - (all_turns @ rest[..., None])[..., 0]
    shaped = few.points_rest + few.points_by_beta @ state.betas
    points = (blended @ shaped[..., None])[..., 0] + few.weights @ shifts
    normals = (blended @ few.normals_rest[..., None])[..., 0]
    return points, normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)


def _normals_apart(one: Array, other: Array) -> Array:
    return (
        np.square(with_normals(np.zeros_like(one).reshape(-1, 3), (one - other).reshape(-1, 3))).sum(1).reshape(one.shape[:-1])
    )


def _robust(squared: Array) -> Array:
    return squared / (squared + _ROBUST_M**2)
