"""Compare two rest poses: find the rotations that bring the joints of a skeleton to the rest pose of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies.kinematics import nearest_rotation

__all__ = ["RestMatch", "rest_turns"]

Array = NDArray[np.float64]

# In the trunk and the feet, bone directions of two skeletons may differ by this much although the rest poses are the same,
# because joints are placed differently (SMPL's neck leans 30 degrees forward).
_PLACEMENT_RAD = np.radians(35)
_TRUNK = ("pelvis", "neck", "head", "jaw", "l_collar", "r_collar", "l_ankle", "r_ankle", "l_foot", "r_foot")
# A body at rest within this angle of an axis counts as standing along it.
_UPRIGHT_RAD = np.radians(30)


@dataclass(frozen=True)
class RestMatch:
    """The paired joints of a skeleton (target) and a rig (source), both at rest."""

    pairs: dict[int, int]
    """Per paired joint of the skeleton, the joint of the rig."""
    parts: dict[str, int]
    """Per part of a human body, the joint of the skeleton; empty for other skeletons."""
    spine: tuple[int, ...]
    """Joints of the skeleton's spine."""
    target: Array
    """[J, 3], joints of the skeleton, metres."""
    source: Array
    """[K, 3], joints of the rig, units of the rig."""
    target_parents: Sequence[int]
    source_parents: Sequence[int]
    above: dict[int, int] = field(init=False)
    """Per paired joint of the skeleton, its nearest paired ancestor; without roots."""
    below: dict[int, list[int]] = field(init=False)
    """Per paired joint of the skeleton, its nearest paired descendants."""

    def __post_init__(self) -> None:
        above: dict[int, int] = {}
        below: dict[int, list[int]] = {joint: [] for joint in self.pairs}
        for joint in self.pairs:
            parent = self.target_parents[joint]
            while parent >= 0 and parent not in self.pairs:
                parent = self.target_parents[parent]
            if parent >= 0:
                above[joint] = parent
                below[parent].append(joint)
        object.__setattr__(self, "above", above)
        object.__setattr__(self, "below", below)

    def both(self, part: str) -> tuple[Array, Array] | None:
        """Return the positions [3] of a body part in the skeleton and in the rig; None if one of them lacks it."""
        joint = self.parts.get(part)
        return (self.target[joint], self.source[self.pairs[joint]]) if joint in self.pairs else None


def rest_turns(match: RestMatch) -> dict[int, Array]:
    """Return the rotation [3, 3] per paired joint of the skeleton from its rest pose to that of the rig.

    First the whole skeleton is aligned, for rigs that face another way or lie at rest. Then each bone gets the smallest
    rotation to the direction of the rig's bone. Trunk, head and feet are aligned as a whole only, unless they differ by a large
    angle.
    """
    trunk = {*(match.parts[name] for name in _TRUNK if name in match.parts), *match.spine}
    whole = _alignment(match)
    turns: dict[int, Array] = {}
    for joint in match.pairs:
        is_trunk = joint in trunk
        # A hand continues the forearm; feet and head are upright independent of the direction of leg or neck.
        start = whole if is_trunk or joint not in match.above else turns[match.above[joint]]
        turns[joint] = start
        directions = _directions(match, joint)
        if directions is None:
            continue
        before, after = start @ directions[0], directions[1]
        angle = np.arctan2(np.linalg.norm(np.cross(before, after)), before @ after)
        if angle > (_PLACEMENT_RAD if is_trunk or not match.below[joint] else 0):
            turns[joint] = _smallest_turn(before, after) @ start
    return turns


def _directions(match: RestMatch, joint: int) -> tuple[Array, Array] | None:
    """Return the directions of the bone of a joint at rest, in skeleton and rig, as unit vectors [3]; None if there is none.

    A bone points to the mean of the paired joints below it; without any, to the only child in both trees.
    """
    below = match.below[joint]
    here, there = match.target[joint], match.source[match.pairs[joint]]
    if below:
        ends = match.target[below], match.source[[match.pairs[other] for other in below]]
    else:
        trees = (match.target, match.target_parents, joint), (match.source, match.source_parents, match.pairs[joint])
        ends = tuple(points[[c for c, parent in enumerate(parents) if parent == at]] for points, parents, at in trees)
        if any(len(points) != 1 for points in ends):
            return None
    directions = []
    for points, origin in zip(ends, (here, there), strict=True):
        offsets = points - origin
        mean, longest = offsets.mean(0), np.linalg.norm(offsets, axis=1).max()
        # Opposite bones, as those of the hips, have no common direction.
        if not np.isfinite(longest) or np.linalg.norm(mean) <= 0.3 * longest:
            return None
        directions.append(mean / np.linalg.norm(mean))
    return directions[0], directions[1]


def _smallest_turn(before: Array, after: Array) -> Array:
    """Return the matrix [3, 3] of the smallest rotation from one unit vector to another."""
    cross = np.cross(before, after)
    sine, cosine = np.linalg.norm(cross), before @ after
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        cross = np.cross(before, np.eye(3)[np.argmin(np.abs(before))])  # any perpendicular axis
        sine = np.linalg.norm(cross)
        return Rotation.from_rotvec(np.pi * cross / sine).as_matrix()
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * cross / sine).as_matrix()


def _alignment(match: RestMatch) -> Array:
    """Return the rotation [3, 3] that best aligns the whole skeleton at rest with the rig at rest."""
    frames = [_body_frame(match, side) for side in (0, 1)]
    if frames[0] is not None and frames[1] is not None:
        return frames[1] @ frames[0].T
    joints = list(match.pairs)
    target, source = match.target[joints], match.source[[match.pairs[joint] for joint in joints]]
    target, source = target - target.mean(0), source - source.mean(0)
    if np.linalg.matrix_rank(target, 1e-3 * np.abs(target).max(initial=0)) < 2 or not np.abs(source).max() > 0:
        return np.eye(3)
    moments = (source / np.abs(source).max()).T @ target
    return nearest_rotation(torch.from_numpy(moments)).numpy()


def _body_frame(match: RestMatch, side: int) -> Array | None:
    """Return the directions left, up and forward of the body at rest as columns [3, 3]; None if unknown.

    Args:
        match: the paired joints.
        side: 0 for the skeleton, 1 for the rig.
    """
    points = {part: both[side] for part in match.parts if (both := match.both(part)) is not None}
    sides = [(f"l_{part}", f"r_{part}") for part in ("hip", "shoulder")]
    pairs = [(points[left], points[right]) for left, right in sides if left in points and right in points]
    tops = [points[part] for part in ("head", "neck") if part in points]
    if len(pairs) == 2 and not tops:
        tops = [(pairs[1][0] + pairs[1][1]) / 2]
    if not pairs or not tops or not {"l_hip", "r_hip"} <= {*points}:
        return None
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        left = sum((a - b) / np.linalg.norm(a - b) for a, b in pairs)
        up = tops[0] - (points["l_hip"] + points["r_hip"]) / 2
        up = up / np.linalg.norm(up)
        # The direction of the neck must not tilt the whole body.
        axis = np.zeros(3)
        axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
        up = axis if up @ axis > np.cos(_UPRIGHT_RAD) else up
        left = left - (left @ up) * up
        left = left / np.linalg.norm(left)
    if not np.isfinite(np.concatenate([left, up])).all():
        return None
    return np.stack([left, up, np.cross(left, up)], 1)
