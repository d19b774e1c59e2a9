"""Which frames of a fitted sequence can be trusted, and in plain words why others cannot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from snarfcli.registration.body_surface import BodySurface
from snarfcli.registration.matches import Agreement

__all__ = ["apart_share", "find_jumps", "is_suspicious", "judge", "unseen_joints", "usual_misfit"]

Array = NDArray[np.float64]

_SUSPICIOUS = 1.3  # times the usual misfit: such a frame is fitted again
_UNTRUSTED = 1.7  # frames with the right pose reach 1.5
_APART_M = 0.06  # a vertex or a point this far from its match has none,
_POINT_SPACINGS, _VERTEX_SPACINGS = 3.0, 1.6  # if this is also that many times the spacings of both
# Share of the vertices, and of the points, that have none. Frames with the right pose have up to 0.3 %; 1.3 % of the points in
# clothes, 17 to 21 % beside a floor and 7 % of the vertices with missing parts, but never both. An arm has 8 % of a body.
_MOST_APART = 0.025
_MOST_LOST = 0.5  # share of the frames that are apart, from which on the others of the sequence cannot be trusted either
# Share of the points that a joint should have by its share of the surface: 0 to 0.36 for limbs that are cut off, which the body
# may then hide in itself; for what is there above 0.9 at most joints, and at least 0.37 at a hand at the chest.
_UNSEEN = 0.35
_LEAST_POINTS = 5  # expected points, below which nothing is said
_MEASURED = 500  # points from which the next one is searched
_WINDOW = 61  # frames around one among which its misfit is judged
_JUMP_M = 0.15  # of a joint, between a frame and the middle of its neighbours
_USUAL_JUMP = 6.0  # times the median of the sequence


def usual_misfit(misfit: Array) -> Array:
    """Return the misfit [T] that is usual around each frame: the median of a window, at most 1.25 of that of the sequence."""
    middle = np.median(misfit)
    return np.minimum(median_filter(misfit, min(_WINDOW, len(misfit)), mode="nearest"), 1.25 * middle)


def is_suspicious(misfit: Array) -> NDArray[np.bool_]:
    """Return which frames [T] agree with their scans less than their neighbours do."""
    return misfit > _SUSPICIOUS * usual_misfit(misfit)


def apart_share(found: Agreement, vertices: Array, points: Array, clothes_m: float = 0.0) -> float:
    """Return the share of the vertices, or of the points if theirs is smaller, that have no match.

    A limb that lies wrong has no points, and its points have no limb; a floor or a missing part raises only one of the shares.

    Args:
        found: of a body and a scan.
        vertices: [K, 3], of the body in any state, metres.
        points: [P, 3], of the scan, metres.
        clothes_m: how far the body may be below the surface, metres.
    """
    far = max(_APART_M, _POINT_SPACINGS * _spacing_m(points), _VERTEX_SPACINGS * _spacing_m(vertices)) + clothes_m
    return float(min((found.of_body > far).mean(), (found.of_scan > far).mean()))


def unseen_joints(partners: NDArray[np.intp], surface: BodySurface) -> NDArray[np.bool_]:
    """Return the joints [J] that the scan does not show: with those that follow them, they have far too few points.

    Args:
        partners: [M], number of the closest vertex of each point, as in `Agreement`.
        surface: the body.
    """
    area = surface.bone_areas
    points = np.bincount(surface.bones[partners], minlength=surface.num_joints) @ surface.follows / len(partners)
    return (points < _UNSEEN * area) & (area * len(partners) >= _LEAST_POINTS)


def _spacing_m(points: Array) -> float:
    """Return the usual distance from one of some points [P, 3] to the next one, metres; 0 for a single point."""
    return float(np.median(KDTree(points).query(points[:_MEASURED], 2)[0][:, 1])) if len(points) > 1 else 0.0


def find_jumps(joints: Array) -> NDArray[np.intp]:
    """Return for each frame [T] the number of the joint that jumps there and back, or -1.

    Of frames in a row that jump, only the one with the longest jump counts.

    Args:
        joints: [T, J, 3], metres.
    """
    jumps = np.full(len(joints), -1, np.intp)
    if len(joints) < 3:
        return jumps
    away = np.linalg.norm(joints[1:-1] - (joints[:-2] + joints[2:]) / 2, axis=2)
    most = away.max(1)
    around = np.maximum(np.append(most[1:], 0.0), np.append(0.0, most[:-1]))
    is_jump = (most > max(_JUMP_M, _USUAL_JUMP * float(np.median(most)))) & (most >= around)
    jumps[1:-1][is_jump] = away.argmax(1)[is_jump]
    return jumps


def judge(
    misfit: Array, residual_m: Array, apart: Array, jumps: NDArray[np.intp], joint_names: tuple[str, ...]
) -> tuple[str, ...]:
    """Return for each frame why it cannot be trusted; "" if it can.

    Args:
        misfit: [T], as in `Agreement`.
        residual_m: [T], metres.
        apart: [T], as from `apart_share`; it also shows that a whole sequence is lost, of which every frame is usual.
        jumps: [T], as from `find_jumps`.
        joint_names: of the joints.
    """
    usual = np.median(residual_m)
    is_worse = misfit > _UNTRUSTED * usual_misfit(misfit)
    is_apart = apart > _MOST_APART
    is_lost = is_worse | is_apart
    most_are_lost = is_apart.mean() > _MOST_LOST
    beside_lost = np.append(is_lost[1:], False) | np.append(False, is_lost[:-1])
    reasons = []
    for frame, joint in enumerate(jumps):
        if is_worse[frame]:
            millimetres = f"{1000 * residual_m[frame]:.1f} mm from the points; usual in this sequence: {1000 * usual:.1f} mm"
            reasons.append(f"the body is {millimetres}")
        elif is_apart[frame]:
            reasons.append(f"{100 * apart[frame]:.0f} % of the body and of the points are far from each other")
        elif joint >= 0 and not beside_lost[frame]:  # the jump is then that of its neighbour
            reasons.append(f"joint {joint_names[joint]} jumps between this frame and its neighbours")
        else:
            reasons.append("most frames of this sequence are lost" if most_are_lost else "")
    return tuple(reasons)
