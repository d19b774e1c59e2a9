"""Find the parts of a human body by the shape of a tree of joints: two legs, two arms, and a head on a trunk between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.trees import common_ancestor, path_up

__all__ = ["ShapeParts", "find_by_shape"]

Array = NDArray[np.float64]

# Bounds of what passes for a person at rest. The human values are those of SMPL's average body and of the usual rigs.
_SAME_LENGTH = 0.05  # of bones left and right, relative
_MIRRORED = 0.1  # distance from the mirrored place, relative to the length of the limb
_SHORT_LIMB = 0.3  # pairs of chains shorter than this, relative to the longest pair, are eyes, ears or twist bones
_NEXT_BONE = 0.85  # other bones of a limb, relative to the shorter of its two long ones; human 0.4
_BONE_RATIO = (0.6, 1.7)  # upper to lower bone of a limb; human 0.9 to 1.2
_ARM_TO_LEG = (0.4, 1.15)  # human 0.6 to 0.75
_TRUNK_TO_LEG = (0.35, 1.2)  # human 0.5 to 0.7
_HEAD_TO_TRUNK = (0.08, 0.9)  # human 0.3 to 0.6
_OTHER_CHAIN = 0.4  # a further chain of trunk, such as a tail or a wing, relative to the leg
_DOWN = -0.8  # cosine of trunk and legs; 0 in animals on four legs
_SIDEWAYS = 0.2  # largest cosine of the axis left to right and the trunk
_FOOT_FORWARD = 0.3  # of the length of a foot
_MAX_CHILDREN, _MAX_CHAIN = 12, 32  # joints that are looked at: the longest chains of a joint, the first of a chain


@dataclass(frozen=True)
class ShapeParts:
    """Joints of a tree that has the shape of a person."""

    joints: dict[str, int]
    """Index of the joint by SMPL's name of the part."""
    has_sides: bool
    """Whether feet point forward and so tell left from right; otherwise left and right may be exchanged."""


@dataclass(frozen=True)
class _Limbs:
    """Two chains of joints that mirror each other."""

    meeting: int
    """The joint above both."""
    chains: tuple[list[int], list[int]]
    bones: int
    """Place in the chains at which the two long bones begin."""
    length: float
    """Of the two long bones."""
    across: Array
    """[3], unit vector from the second chain to the first."""

    def joints(self, place: int) -> list[int]:
        """Return the two joints at a place that counts from the beginning of the long bones; none beyond the chains."""
        return [chain[self.bones + place] for chain in self.chains if 0 <= self.bones + place < len(chain)]


class _Tree:
    """Children, chains and lengths of a tree."""

    def __init__(self, parents: Sequence[int], points: Array, tips: set[int]) -> None:
        self.parents, self.points, self.tips = parents, points, tips
        self.reach = np.zeros(len(parents))  # length of the longest chain below
        children: list[list[int]] = [[] for _ in parents]
        for joint in range(len(parents) - 1, -1, -1):
            if (parent := parents[joint]) >= 0:
                children[parent].append(joint)
                self.reach[parent] = max(self.reach[parent], self.distance(parent, joint) + self.reach[joint])
        self.children = [sorted(each, key=lambda joint: (-self.to_end(joint), joint)) for each in children]

    def distance(self, first: int, second: int) -> float:
        return float(np.linalg.norm(self.points[first] - self.points[second]))

    def to_end(self, joint: int) -> float:
        """Return the length of the longest chain that begins with the bone to this joint."""
        return self.distance(self.parents[joint], joint) + self.reach[joint]

    def chain(self, joint: int) -> list[int]:
        """Return the longest chain from a joint to a leaf."""
        chain = [joint]
        while self.children[chain[-1]] and len(chain) < _MAX_CHAIN:
            chain.append(self.children[chain[-1]][0])
        return chain

    def middle(self, joints: Sequence[int]) -> Array:
        return self.points[list(joints)].mean(0)


def find_by_shape(parents: Sequence[int], points: Array, tips: set[int]) -> ShapeParts | None:
    """Find the parts of a person in a tree of joints at rest; None unless the shape is clear.

    A person has two pairs of chains that mirror each other, with two long bones each; the legs point away from the trunk that
    joins them to the arms, and a head goes on beyond it. Animals on four legs, with tails or wings, and things do not pass.

    Args:
        parents: J parents, -1 for a root; a parent comes before its children.
        points: [J, 3], joints at rest, any unit, any direction up.
        tips: joints that only mark the end of a bone, such as a BVH file's End Sites.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.ptp(points, axis=0).max(initial=0)
    if not np.isfinite(points).all() or not 0 < size < np.inf:
        return None
    tree = _Tree(parents, (points - points[0]) / size, tips)
    limbs = _limbs(tree)
    if len(limbs) != 2:
        return None
    found = [parts for legs, arms in (limbs, limbs[::-1]) if (parts := _person(tree, legs, arms)) is not None]
    return found[0] if len(found) == 1 else None


def _limbs(tree: _Tree) -> list[_Limbs]:
    """Return the pairs of mirrored chains, without those within other limbs and those that are far shorter."""
    limbs: list[_Limbs] = []
    inside: set[int] = set()
    for joint, parent in enumerate(tree.parents):
        if parent in inside:
            inside.add(joint)
            continue
        for first, second in combinations(tree.children[joint][:_MAX_CHILDREN], 2):
            pair = _mirrored(tree, joint, first, second)
            if pair is not None and not inside & {first, second}:
                limbs.append(pair)
                inside |= {first, second}
    longest = max((pair.length for pair in limbs), default=0)
    return [pair for pair in limbs if pair.length >= _SHORT_LIMB * longest]


def _mirrored(tree: _Tree, meeting: int, first: int, second: int) -> _Limbs | None:
    """Return the pair of chains that begin with two children of a joint if they mirror each other and look like limbs."""
    chains = tree.chain(first), tree.chain(second)
    bones = [np.linalg.norm(np.diff(tree.points[[meeting, *chain]], axis=0), axis=1) for chain in chains]
    shared = min(map(len, bones))
    bones = [each[:shared] for each in bones]
    if shared < 3 or np.abs(bones[0] - bones[1]).max() > _SAME_LENGTH * max(bones[0].max(), bones[1].max()):
        return None
    mean = (bones[0] + bones[1])[1:] / 2
    at = int(np.argmax(mean[:-1] + mean[1:]))
    upper, lower = mean[at], mean[at + 1]
    others = np.delete(mean, [at, at + 1])
    if (
        lower <= 0
        or not _BONE_RATIO[0] <= upper / lower <= _BONE_RATIO[1]
        or others.max(initial=0) > _NEXT_BONE * min(upper, lower)
    ):
        return None
    left, right = (tree.points[chain[: at + 3]] - tree.points[meeting] for chain in chains)
    across = (left - right).sum(0)
    norm = np.linalg.norm(across)
    if norm <= _MIRRORED * (upper + lower):
        return None
    across = across / norm
    mirrored = right - 2 * np.outer(right @ across, across)
    if np.linalg.norm(left - mirrored, axis=1).max() > _MIRRORED * (upper + lower):
        return None
    return _Limbs(meeting, chains, at, float(upper + lower), across)


def _person(tree: _Tree, legs: _Limbs, arms: _Limbs) -> ShapeParts | None:
    """Return the parts of a person with these legs and arms; None if it is none."""
    meeting = common_ancestor(legs.meeting, arms.meeting, tree.parents)
    if meeting < 0 or legs.meeting == arms.meeting or arms.meeting == meeting:
        return None
    trunk = tree.middle(arms.joints(0)) - tree.middle(legs.joints(0))
    length = np.linalg.norm(trunk)
    down = tree.middle(legs.joints(2)) - tree.middle(legs.joints(0))
    if not _TRUNK_TO_LEG[0] <= length / legs.length <= _TRUNK_TO_LEG[1]:
        return None
    up = trunk / length
    is_upright = down @ up <= _DOWN * np.linalg.norm(down)
    is_sideways = max(abs(legs.across @ up), abs(arms.across @ up)) <= _SIDEWAYS and abs(legs.across @ arms.across) >= 0.95
    if not is_upright or not is_sideways or not _ARM_TO_LEG[0] <= arms.length / legs.length <= _ARM_TO_LEG[1]:
        return None
    inner = {*path_up(arms.meeting, tree.parents), *path_up(legs.meeting, tree.parents)}
    starts = {joint for limbs in (legs, arms) for chain in limbs.chains for joint in chain[: limbs.bones + 1]}
    others = [joint for at in inner for joint in tree.children[at] if joint not in inner | starts]
    heads = [
        joint for joint in others if tree.parents[joint] == arms.meeting and _is_head(tree, joint, arms, up, float(length))
    ]
    if len(heads) != 1 or any(tree.to_end(joint) > _OTHER_CHAIN * legs.length for joint in others if joint not in heads):
        return None
    return _named(tree, legs, arms, heads[0], up)


def _is_head(tree: _Tree, joint: int, arms: _Limbs, up: Array, trunk: float) -> bool:
    """Return whether the chain of a joint goes up in the middle, as far as a neck and a head may."""
    chain = tree.chain(joint)
    offsets = tree.points[chain] - tree.points[arms.meeting]
    rises = offsets @ up
    is_central = np.abs(offsets[0] @ arms.across) <= 0.1 * trunk
    return bool(is_central and _HEAD_TO_TRUNK[0] * trunk <= rises.max() <= _HEAD_TO_TRUNK[1] * trunk)


def _named(tree: _Tree, legs: _Limbs, arms: _Limbs, head: int, up: Array) -> ShapeParts:
    """Return the joints by part, with the sides that the feet tell."""
    left, has_sides = _left(tree, legs, up)
    joints = {"pelvis": legs.meeting, **_neck_and_head(tree, head)}
    for limbs, parts in ((legs, ("hip", "knee", "ankle", "foot")), (arms, ("shoulder", "elbow", "wrist"))):
        order = "lr" if limbs.across @ left > 0 else "rl"
        for place, part in enumerate(parts):
            pair = limbs.joints(place)
            if len(pair) == 2 and not tree.tips & {*pair}:
                joints |= {f"{side}_{part}": joint for side, joint in zip(order, pair, strict=True)}
        if limbs is arms and arms.bones > 0:
            joints |= {f"{side}_collar": joint for side, joint in zip(order, arms.joints(-1), strict=True)}
    return ShapeParts(joints, has_sides)


def _left(tree: _Tree, legs: _Limbs, up: Array) -> tuple[Array, bool]:
    """Return the direction [3] of the left side, and whether the feet tell it."""
    toes = legs.joints(3)
    if len(toes) < 2:
        return legs.across, False
    feet = tree.points[toes] - tree.points[legs.joints(2)]
    forward = feet.sum(0)
    forward = forward - (forward @ up) * up - (forward @ legs.across) * legs.across
    is_clear = np.linalg.norm(forward) >= _FOOT_FORWARD * np.linalg.norm(feet, axis=1).sum()
    left = np.asarray(np.cross(up, forward), dtype=np.float64) if is_clear else legs.across
    return left, bool(is_clear)


def _neck_and_head(tree: _Tree, joint: int) -> dict[str, int]:
    """Return neck and head of the chain above the arms; a chain of one joint is the head."""
    chain = [joint]
    while len(tree.children[chain[-1]]) == 1:  # eyes and jaw are children of the head
        chain += tree.children[chain[-1]]
    if len(chain) > 1 and not tree.children[chain[-1]]:
        bones = [tree.distance(first, second) for first, second in pairwise(chain)]
        if chain[-1] in tree.tips or (len(bones) > 1 and bones[-1] > 1.2 * np.mean(bones[:-1])):  # the top of the head
            chain.pop()
    return {"head": chain[-1]} | ({"neck": chain[0]} if len(chain) > 1 else {})
