"""Find the joints of a tree that are parts of a human body, by the joint names of common programs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["BodyParts", "find_body_parts", "plain_name"]

# Prefixes of all joint names in Mixamo, 3ds Max, MotionBuilder, Character Creator, VRoid, Rigify.
_PREFIXES = ({"mixamorig"}, {"bip"}, {"character"}, {"cc", "base"}, {"j", "bip", "c", "sec"}, {"def", "org"})
_SUFFIXES = {"smplhf", "smplx", "jnt", "bone"}
_SIDES = {"l": "l", "left": "l", "r": "r", "right": "r"}
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")

# Part of the body -> names without side, the most reliable first. A joint is used for one part only, the first that matches: a
# `foot` is the joint of the toes if there is an ankle, as in SMPL, else the ankle; a `shoulder` is the collar bone if there is
# an arm.
_MIDDLE = {
    "pelvis": ("pelvis", "hips", "hip", "root"),
    "neck": ("neck", "neck1", "lowerneck", "neck0", "necklower"),
    "head": ("head",),
    "jaw": ("jaw",),
}
_SIDED = {
    "hip": ("upleg", "upperleg", "thigh", "femur", "hip", "hipjoint"),
    "knee": ("knee", "lowerleg", "lowleg", "loleg", "shin", "calf", "tibia", "leg"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "ball", "toe", "toes", "toe0", "toe1", "foot"),
    "shoulder": ("upperarm", "uparm", "arm", "humerus", "shoulder"),
    "collar": ("collar", "clavicle", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "loarm", "radius"),
    "wrist": ("wrist", "hand"),
    "eye": ("eye",),
    **{
        f"{finger}{number}": (f"{finger}{number}", f"hand{finger}{number}", *([f"little{number}"] if finger == "pinky" else []))
        for finger in ("index", "middle", "pinky", "ring", "thumb")
        for number in (1, 2, 3)
    },
}
# SMPL's hand joints are at the knuckles, where the middle finger begins.
_HAND = ("hand", "fingerbase", "fingers", "middle1", "handmiddle1", "index1", "handindex1", "finger1")


@dataclass(frozen=True)
class BodyParts:
    """Joints of a tree that were recognised as parts of a human body."""

    joints: dict[str, int]
    """Index of the joint by SMPL's name of the part, such as `l_knee` or `l_index1`; without the spine."""
    spine: tuple[int, ...]
    """Indices of the joints between pelvis and neck, from bottom to top."""


def plain_name(name: str) -> str:
    """Return the name of a joint in a common spelling: `LeftUpLeg`, `mixamorig:LeftUpLeg` and `up_leg.L` become `l_upleg`."""
    words = [word.lower() for word in _WORD.findall(re.split(r"[:|]", name)[-1])]
    words = [str(int(word)) if word.isdecimal() and len(word) < 9 else word for word in words]
    words = _without_prefix(words)
    while len(words) > 1 and words[-1] in _SUFFIXES:
        words.pop()
    for at, word in enumerate(words):
        if word in _SIDES and len(words) > 1:
            return f"{_SIDES[word]}_{''.join(words[:at] + words[at + 1 :])}"
    joined = "".join(words)
    for start, side in (("left", "l"), ("right", "r"), ("l", "l"), ("r", "r")):
        rest = joined.removeprefix(start)
        if rest != joined and rest and (len(start) > 1 or rest in _ALL_SIDED):
            return f"{side}_{rest}"
    return joined


def _without_prefix(words: list[str]) -> list[str]:
    for prefix in _PREFIXES:
        rest = words
        while len(rest) > 1 and (rest[0] in prefix or (rest is not words and rest[0].isdecimal())):
            rest = rest[1:]
        if rest is not words and (words[0] not in ("j", "c", "sec") or len(words) - len(rest) > 1):
            return rest
    return words


_ALL_SIDED = {name for names in _SIDED.values() for name in names} | set(_HAND)


def find_body_parts(names: Sequence[str], parents: Sequence[int]) -> BodyParts:
    """Find the parts of a human body among the joints of a tree.

    Args:
        names: J names in any of the usual spellings: SMPL's, CMU's and MotionBuilder's (`LeftUpLeg`), Mixamo's, Unreal's
            (`thigh_l`), 3ds Max's (`Bip01 L Thigh`), Blender's (`thigh.L`), ASF's (`lfemur`).
        parents: J parents, -1 for a root; a parent comes before its children.

    Returns:
        The recognised parts; joints with other names are left out.
    """
    numbers: dict[str, int] = {}
    for joint, name in enumerate(names):
        numbers.setdefault(plain_name(name), joint)
    found: dict[str, int] = {}
    taken: set[int] = set()

    def look(part: str, candidates: Sequence[str]) -> None:
        joint = next((numbers[name] for name in candidates if name in numbers and numbers[name] not in taken), None)
        if joint is not None:
            found[part] = joint
            taken.add(joint)

    for part, candidates in _MIDDLE.items():
        look(part, candidates)
    for side in "lr":
        for part, candidates in _SIDED.items():
            look(f"{side}_{part}", [f"{side}_{name}" for name in candidates])
        # a finger may stand for the whole hand as well
        hands = (numbers.get(f"{side}_{name}") for name in _HAND)
        hand = next((joint for joint in hands if joint not in (None, found.get(f"{side}_wrist"))), None)
        if hand is not None:
            found[f"{side}_hand"] = hand
    return BodyParts(found, _spine(found, parents))


def _spine(found: dict[str, int], parents: Sequence[int]) -> tuple[int, ...]:
    """Return the joints between the pelvis and the neck, or the head, collar or shoulder if there is no neck."""
    if "pelvis" not in found:
        return ()
    tops = [found[name] for name in ("neck", "head", "l_collar", "l_shoulder") if name in found]
    if not tops:
        return ()
    chain = []
    joint = parents[tops[0]]
    while joint >= 0 and joint != found["pelvis"]:
        chain.append(joint)
        joint = parents[joint]
    if joint < 0:  # the pelvis is beside the spine, as another child of a common ancestor
        above = _ancestors(found["pelvis"], parents)
        chain = [joint for joint in chain if joint not in above]
    return tuple(joint for joint in reversed(chain) if joint not in found.values())


def _ancestors(joint: int, parents: Sequence[int]) -> set[int]:
    ancestors = set()
    while joint >= 0:
        ancestors.add(joint)
        joint = parents[joint]
    return ancestors
