"""Joint names in a common spelling, to compare the names of two skeletons."""

from __future__ import annotations

import re

__all__ = ["plain_name"]

# Prefixes of all joint names in Mixamo, 3ds Max, MotionBuilder, Character Creator, VRoid, Rigify.
_PREFIXES = ({"mixamorig"}, {"bip"}, {"character"}, {"cc", "base"}, {"j", "bip", "c", "sec"}, {"def", "org"})
_SUFFIXES = {"smplhf", "smplx", "jnt", "bone"}
_SIDES = {"l": "l", "left": "l", "r": "r", "right": "r"}
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
# Names before which a single letter is the side, as in `lfemur`; other words may begin with l or r.
_FINGERS = "|".join(f"(hand)?{finger}[123]" for finger in ("index", "middle", "pinky", "ring", "thumb")) + "|little[123]"
_SIDED = re.compile(
    "(up|upper|low|lower|lo)leg|leg|thigh|femur|hip(joint)?|knee|shin|calf|tibia|ankle|foot|toe(base|s|0|1)?|ball"
    "|(upper|up|fore|lower|low|lo)?arm|humerus|shoulder|collar|clavicle|elbow|radius|wrist|hand|eye"
    f"|fingerbase|fingers|finger1|{_FINGERS}"
)


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
        if rest != joined and rest and (len(start) > 1 or _SIDED.fullmatch(rest)):
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
