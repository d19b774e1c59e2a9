"""The paired joints of a skeleton and a rig at rest, and what can be told from their places: bones, limbs, left and up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["LIMB_ROOTS", "RestMatch", "body_frame", "frame_of", "smallest_turn", "unit"]

Array = NDArray[np.float64]

LIMB_ROOTS = {
    "l_arm": ("l_collar", "l_shoulder"),
    "r_arm": ("r_collar", "r_shoulder"),
    "l_leg": ("l_hip",),
    "r_leg": ("r_hip",),
}
"""Per limb of a human body, the parts with which it may begin."""
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

    @property
    def names(self) -> dict[int, str]:
        """Per paired joint of the skeleton that is a part of a human body, the name of the part."""
        return {joint: part for part, joint in self.parts.items() if joint in self.pairs}

    def points(self, side: int) -> dict[str, Array]:
        """Return the positions [3] at rest of all paired parts of the body; `side` is 0 for the skeleton, 1 for the rig."""
        return {part: self.target[joint] if side == 0 else self.source[self.pairs[joint]] for joint, part in self.names.items()}

    def spine_points(self, side: int) -> list[Array]:
        """Return the positions [3] at rest of the paired joints of the spine, from bottom to top; `side` as in `points`."""
        joints = [joint for joint in self.spine if joint in self.pairs]
        return [self.target[joint] if side == 0 else self.source[self.pairs[joint]] for joint in joints]

    def limb(self, name: str) -> list[int]:
        """Return the paired joints of a limb, a name of `LIMB_ROOTS`, from the trunk outwards; empty if it has none."""
        root = next((self.parts[part] for part in LIMB_ROOTS[name] if self.parts.get(part) in self.pairs), None)
        if root is None:
            return []
        joints = [root]
        for joint in joints:
            joints += self.below[joint]
        return joints

    def bone_ends(self, joint: int) -> tuple[list[int], list[int]] | None:
        """Return the joints to whose mean the bone of a joint points, in skeleton and rig; None if it has no direction.

        These are the paired joints below, or without any the only child in both trees. In a human body the chest's bone points
        to the neck alone. The pelvis has no bone, since where legs and spine begin relative to it differs between skeletons.
        Neither have ankles and wrists without a paired joint below: their children, often End Sites, may be soles or anything.
        """
        part = self.names.get(joint, "")
        if part == "pelvis" and "l_hip" in self.parts:
            return None
        below = self.below[joint]
        if self.spine and joint == self.spine[-1] and self.parts.get("neck") in below:
            below = [self.parts["neck"]]
        if below:
            return below, [self.pairs[other] for other in below]
        if part[2:] in ("ankle", "wrist"):
            return None
        trees = (self.target_parents, joint), (self.source_parents, self.pairs[joint])
        target, source = ([child for child, parent in enumerate(parents) if parent == at] for parents, at in trees)
        return (target, source) if len(target) == len(source) == 1 else None

    def bone(self, joint: int) -> tuple[Array, Array] | None:
        """Return the directions of the bone of a joint at rest, in skeleton and rig, as unit vectors [3]; None without one."""
        ends = self.bone_ends(joint)
        if ends is None:
            return None
        directions = []
        for points, chosen, at in zip((self.target, self.source), ends, (joint, self.pairs[joint]), strict=True):
            offsets = points[chosen] - points[at]
            mean, longest = offsets.mean(0), np.linalg.norm(offsets, axis=1).max()
            # Opposite bones have no common direction.
            if not np.isfinite(longest) or np.linalg.norm(mean) <= 0.3 * longest:
                return None
            directions.append(mean / np.linalg.norm(mean))
        return directions[0], directions[1]


def body_frame(points: Mapping[str, Array]) -> Array | None:
    """Return the directions left, up and forward of a body at rest as columns [3, 3]; None if unknown.

    Args:
        points: [3] per part of the body.
    """
    sides = [(f"l_{part}", f"r_{part}") for part in ("hip", "shoulder")]
    pairs = [(points[left], points[right]) for left, right in sides if left in points and right in points]
    tops = [points[part] for part in ("head", "neck") if part in points]
    if len(pairs) == 2 and not tops:
        tops = [(pairs[1][0] + pairs[1][1]) / 2]
    if not pairs or not tops or not {"l_hip", "r_hip"} <= {*points}:
        return None
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        lefts = np.stack([unit(a - b) for a, b in pairs])
        if len(lefts) == 2 and not lefts[0] @ lefts[1] > 0.5:  # arms that both lie along one axis say nothing about the sides
            lefts = lefts[:1]
        up = unit(tops[0] - (points["l_hip"] + points["r_hip"]) / 2)
        # The direction of the neck must not tilt the whole body.
        axis = np.zeros(3)
        axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
        up = axis if up @ axis > np.cos(_UPRIGHT_RAD) else up
        left = lefts.sum(0)
        left = unit(left - (left @ up) * up)
    frame = np.stack([left, up, np.cross(left, up)], 1)
    return frame if np.isfinite(frame).all() else None


def frame_of(left: Array, up: Array) -> Array:
    """Return orthonormal frames [..., 3, 3] with columns left, up, forward; `left` [..., 3] is kept, `up` only roughly."""
    left = unit(left)
    up = unit(up - (left * up).sum(-1, keepdims=True) * left)
    return np.stack([left, up, np.cross(left, up)], -1)


def unit(vectors: Array) -> Array:
    """Return vectors [..., 3] of length 1; NaN for vectors of length 0."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def smallest_turn(before: Array, after: Array) -> Array:
    """Return the matrices [..., 3, 3] of the smallest rotations from unit vectors [..., 3] to others."""
    before, after = np.broadcast_arrays(before, after)
    cross, cosine = np.cross(before, after), (before * after).sum(-1, keepdims=True)
    sine = np.linalg.norm(cross, axis=-1, keepdims=True)
    other = unit(np.cross(before, np.eye(3)[np.argmin(np.abs(before), -1)]))  # any perpendicular axis, for opposite vectors
    axis = np.where(sine < 1e-12, other, cross / np.maximum(sine, 1e-12))
    vectors = np.arctan2(sine, cosine) * axis
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*before.shape, 3)
