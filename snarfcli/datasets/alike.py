"""Compare the poses of sequences: which stand still, and which show the same poses as another.

Artists' files often have a clip with the rest pose, and a clip twice, with and without its way through the world. A held-out
sequence of either kind would measure nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["find_twins", "is_named_rest", "is_still", "pose_points"]

_TOLERANCE = 0.01  # share of the skeleton's size; a breathing animal moves by more
_LEVER = 0.2  # share of the skeleton's size; so a joint at the end of a chain counts from 3 degrees
_TRUNK = 0.75  # share of the joints that hang on the trunk
_REST_NAME = re.compile(r"(^|.*\b)(((rest|bind|default|reference|ref|neutral) ?pose)|rest|bind)( ?\d+)?$|^[ta] ?pose( ?\d+)?$")
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


def is_named_rest(name: str) -> bool:
    """Return whether a clip is a rest pose by its name: `Rest_Pose`, `TPose`, `Armature|bind pose`, but not `walk to rest`."""
    words = " ".join(word.lower() for word in _WORD.findall(re.split(r"[|:]", name)[-1]))
    found = _REST_NAME.match(words)
    return found is not None and (not found[1] or "pose" in words)


def pose_points(posed_from_rest: NDArray, joints_rest: NDArray, parents: Sequence[int]) -> NDArray[np.float32]:
    """Return points [T, P, 3] that differ between poses, but not with place and direction of the whole subject; 1 is its size.

    Each joint carries four points. They are seen from the trunk, the last joint on the way down from the root that still
    carries most others: in some files it is the root that moves through the world, in others the hips below it.

    Args:
        posed_from_rest: [T, J, 4, 4], bone transforms.
        joints_rest: [J, 3], joints at rest.
        parents: J parents, -1 for a root; a parent comes before its children.
    """
    size = max(float(np.ptp(joints_rest, axis=0).max()), 1e-12)
    trunk, members = _trunk(parents)
    try:
        relative = np.linalg.inv(posed_from_rest[:, [trunk]]) @ posed_from_rest[:, members]
    except np.linalg.LinAlgError:
        relative = posed_from_rest[:, members]
    ends = np.concatenate([np.zeros((1, 3)), _LEVER * np.eye(3)])
    points = joints_rest[members][:, None] + size * ends
    moved = np.einsum("tjab,jpb->tjpa", relative[..., :3, :3], points) + relative[:, :, None, :3, 3]
    return (moved.reshape(len(moved), -1, 3) / size).astype(np.float32)


def _trunk(parents: Sequence[int]) -> tuple[int, list[int]]:
    """Return the joint from which poses are seen, and the joints that hang on it."""
    below: list[set[int]] = [{joint} for joint in range(len(parents))]
    for joint in reversed(range(len(parents))):
        if parents[joint] >= 0:
            below[parents[joint]] |= below[joint]
    trunk = max((joint for joint, parent in enumerate(parents) if parent < 0), key=lambda root: len(below[root]))
    while heavy := [j for j, parent in enumerate(parents) if parent == trunk and len(below[j]) >= _TRUNK * len(parents)]:
        trunk = heavy[0]
    return trunk, sorted(below[trunk])


def is_still(points: NDArray[np.float32]) -> bool:
    """Return whether a clip of several frames [T, P, 3] shows one pose only."""
    return len(points) > 1 and bool(_apart(points, points[0]).max() < _TOLERANCE)


def find_twins(points: Mapping[str, NDArray[np.float32]]) -> list[list[str]]:
    """Return the groups of sequences of which one shows the poses of the others, in any order and at any pace.

    Args:
        points: [T, P, 3] per name, as `pose_points` returns them.
    """
    names = list(points)
    if not names:
        return []
    lows, highs = (np.stack([bound(points[name], axis=0) for name in names]) for bound in (np.min, np.max))
    leader = {name: name for name in names}
    for number, name in enumerate(names):
        # Poses between those of another sequence are within its bounds: this leaves few sequences to compare.
        inside = (lows[number] >= lows - _TOLERANCE).all((1, 2)) & (highs[number] <= highs + _TOLERANCE).all((1, 2))
        for other in (names[index] for index in np.flatnonzero(inside) if index != number):
            if leader[other] != leader[name] and _is_part(points[name], points[other]):
                old, new = sorted((leader[name], leader[other]), reverse=True)
                leader = {key: new if value == old else value for key, value in leader.items()}
    groups = [[name for name in names if leader[name] == first] for first in names if leader[first] == first]
    return [group for group in groups if len(group) > 1]


def _is_part(points: NDArray[np.float32], whole: NDArray[np.float32]) -> bool:
    """Return whether every pose [P, 3] of `points` lies on the way from pose to pose of `whole`."""
    starts = whole[:-1] if len(whole) > 1 else whole
    along = whole[1:] - starts if len(whole) > 1 else np.zeros_like(whole)
    length = np.maximum((along * along).sum((1, 2)), 1e-12)
    for pose in points:
        share = np.clip(((pose - starts) * along).sum((1, 2)) / length, 0, 1)
        if _apart(starts + share[:, None, None] * along, pose).min() >= _TOLERANCE:
            return False
    return True


def _apart(poses: NDArray[np.float32], pose: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest distance of a point [P, 3] of `pose` in each of the poses [T, P, 3]."""
    return np.sqrt(((poses - pose) ** 2).sum(-1)).max(-1)
