"""Find the joints of a tree that are parts of a human body, by their names.

Each name is read as words (`name_words`). A joint may then be several parts: `LeftLeg` is the shin below a `LeftUpLeg` and the
thigh above a `LeftShin`. Each limb takes the joints that fit best, as words and as a chain from parent to child.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from snarfcli.motions.limb_search import best_chain
from snarfcli.motions.name_words import NOTHING, JointName, read_names
from snarfcli.motions.plain_names import plain_name
from snarfcli.motions.trees import common_ancestor, path_up

__all__ = ["REQUIRED_PARTS", "BodyParts", "find_body_parts", "plain_name", "spine_between"]

REQUIRED_PARTS = ("pelvis", "l_hip", "r_hip", "l_knee", "r_knee", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow")
"""SMPL's names of the parts without which a tree is no human body."""

Words = frozenset[str]


def _costs(text: str) -> dict[Words, float]:
    """Return {words: cost} of a text such as `upper+arm 0, arm 1`; lower costs are preferred."""
    entries = (entry.rsplit(maxsplit=1) for entry in text.split(","))
    return {frozenset(words.strip().split("+")): float(cost) for words, cost in entries}


# Part -> words of its names, and how much the names speak for other parts or are less usual. A `foot` is the joint of the toes
# if there is an ankle, as in SMPL, else the ankle; a `shoulder` is the collar bone if there is an arm.
_LEG = {
    "hip": _costs("upper+leg 0, thigh 0.1, upper+thigh 0.2, hip 1, leg 2.5"),
    "knee": _costs("knee 0, lower+leg 0.1, shin 0.2, leg 1"),
    "ankle": _costs("ankle 0, foot 1, leg 4"),
    "foot": _costs("toe+base 0, ball 0.1, toe 0.2, big+toe 0.6, foot 2, leg 5"),
}
_ARM = {
    "collar": _costs("collar 0, scapula 0.5, shoulder 1"),
    "shoulder": _costs("upper+arm 0, arm 1, humerus 1.1, shoulder 2"),
    "elbow": _costs("elbow 0, fore+arm 0.1, lower+arm 0.2, radius 0.3, ulna 0.4, arm 3"),
    "wrist": _costs("wrist 0, hand 1, arm 4"),
}
_HEAD = {"neck": _costs("neck 0, lower+neck 0.5"), "head": _costs("head 0")}
_PELVIS = _costs("pelvis 0, hip 1, lower+body 1.5, lower+torso 1.5")
_ROOT, _OF_WORLD = 4.5, 1.5  # cost of a `root` as pelvis, and of one that is above the joint where the legs meet
_MEETING, _TRUNK_MEETING = 5.0, 2.5  # cost of the joint where the legs meet as pelvis, and of one that is named as the trunk
_NOT_ABOVE_LEGS = 3.0  # cost of a pelvis that is not above both legs
_WITHOUT = {"hip": 12.0, "knee": 12.0, "shoulder": 12.0, "elbow": 12.0}  # cost of a limb without the part
_WITHOUT_OTHERS = 6.0
_TRUNK = {"spine", "torso", "neck", "head"}
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
# SMPL's hand joints are at the knuckles, where the middle finger begins: word and number, the best first.
_KNUCKLES = (("hand", ()), ("finger", ()), ("middle", (1,)), ("index", (1,)), ("finger", (1,)))
_NUMBER, _PER_NUMBER = 0.3, 0.01  # cost of a number: `neck` before `neck1` before `neck2`
_MAX_DOUBT = 4.5
_MAX_STRICT_COST = 2.0  # of names that count even if there is no whole body


@dataclass(frozen=True)
class BodyParts:
    """Joints of a tree that were recognised as parts of a human body."""

    joints: dict[str, int]
    """Index of the joint by SMPL's name of the part, such as `l_knee` or `l_index1`; without the spine."""
    spine: tuple[int, ...]
    """Indices of the joints between pelvis and neck, from bottom to top."""

    @property
    def missing(self) -> list[str]:
        """The required parts that were not recognised."""
        return [part for part in REQUIRED_PARTS if part not in self.joints]


def find_body_parts(names: Sequence[str], parents: Sequence[int]) -> BodyParts:
    """Find the parts of a human body among the joints of a tree.

    If the names describe no whole body, only those that are beyond doubt count, so that an animal keeps its own names.

    Args:
        names: J names in the spelling of any program, with or without a common prefix or suffix: SMPL's, CMU's and
            MotionBuilder's (`LeftUpLeg`), Mixamo's, Unreal's (`thigh_l`), 3ds Max's (`Bip01 L Thigh`), Blender's (`thigh.L`),
            ASF's (`lfemur`), Daz's (`lThighBend`), MikuMikuDance's in Japanese.
        parents: J parents, -1 for a root; a parent comes before its children.

    Returns:
        The recognised parts; joints with other names are left out.
    """
    understood = read_names(names)
    if any(name.is_deforming for name in understood):  # a rig with controls: those bones that move the mesh decide
        parts = _find([name if name.is_deforming else NOTHING for name in understood], parents)
        if not parts.missing:
            return parts
    parts = _find(understood, parents)
    return parts if not parts.missing else _find(understood, parents, is_strict=True)


def _find(names: Sequence[JointName], parents: Sequence[int], *, is_strict: bool = False) -> BodyParts:
    found = _chain(_HEAD, names, "", parents, is_strict)
    for side in "lr":
        for limb in (_LEG, _ARM):
            found |= {f"{side}_{part}": joint for part, joint in _chain(limb, names, side, parents, is_strict).items()}
        found |= _hand_and_eye(names, side, found)
    jaw = next(
        (joint for joint, name in enumerate(names) if name.doubt <= 0 and (name.side, name.words) == ("", {"jaw"})), None
    )
    found |= {} if jaw is None else {"jaw": jaw}
    pelvis = _pelvis(names, parents, found, is_strict)
    found |= {} if pelvis is None else {"pelvis": pelvis}
    if not is_strict:
        found |= _neck_and_head(names, parents, found)
    return BodyParts(found, spine_between(found, parents))


def _chain(
    limb: Mapping[str, dict[Words, float]], names: Sequence[JointName], side: str, parents: Sequence[int], is_strict: bool
) -> dict[str, int]:
    candidates = {part: _candidates(names, side, costs, is_strict) for part, costs in limb.items()}
    return best_chain(candidates, {part: _WITHOUT.get(part, _WITHOUT_OTHERS) for part in limb}, parents)


def _candidates(names: Sequence[JointName], side: str, costs: dict[Words, float], is_strict: bool) -> dict[int, float]:
    """Return {joint: cost} of the joints whose names are among `costs`."""
    candidates = {}
    for joint, name in enumerate(names):
        if name.side != side or name.words not in costs or name.doubt > _MAX_DOUBT:
            continue
        cost = costs[name.words]
        is_first = not name.numbers or (name.numbers in ((0,), (1,)) and name.words <= {"toe", "neck"})
        is_clear = name.doubt <= 0 and cost <= _MAX_STRICT_COST and is_first
        if is_clear or not is_strict:
            number = min(sum(number * 0.1**at for at, number in enumerate(name.numbers)), 20)
            candidates[joint] = cost + name.doubt + (_NUMBER + _PER_NUMBER * number if name.numbers else 0)
    return candidates


def _hand_and_eye(names: Sequence[JointName], side: str, found: Mapping[str, int]) -> dict[str, int]:
    """Return eye, knuckles and finger joints of a side; a finger may stand for the knuckles as well."""
    first: dict[tuple[Words, tuple[int, ...]], int] = {}
    for joint, name in enumerate(names):
        if name.side == side and name.doubt <= 0 and joint != found.get(f"{side}_wrist"):
            first.setdefault((name.words, name.numbers), joint)
    looked_up = {f"{finger}{at}": first.get((frozenset({finger}), (at,))) for finger in _FINGERS for at in (1, 2, 3)}
    looked_up["eye"] = first.get((frozenset({"eye"}), ()))
    knuckles = (first.get((frozenset({word}), numbers)) for word, numbers in _KNUCKLES)
    looked_up["hand"] = next((joint for joint in knuckles if joint is not None), None)
    return {f"{side}_{part}": joint for part, joint in looked_up.items() if joint is not None}


def _pelvis(names: Sequence[JointName], parents: Sequence[int], found: Mapping[str, int], is_strict: bool) -> int | None:
    """Return the joint of the pelvis: by name, or else where the legs meet, as in Rigify's or Kinect's spine."""
    named = _candidates(names, "", _PELVIS, is_strict)
    roots = {joint: _ROOT for joint, name in enumerate(names) if name.side == "" and name.words == {"root"}}
    if "l_hip" not in found or "r_hip" not in found or is_strict:
        return _cheapest(roots | named)
    meeting = common_ancestor(found["l_hip"], found["r_hip"], parents)
    above = set(path_up(meeting, parents))
    named = {joint: cost + (0 if joint in above else _NOT_ABOVE_LEGS) for joint, cost in named.items()}
    # A root above the joint where the legs meet is that of the world.
    roots = {joint: cost + (_OF_WORLD if joint in above - {meeting} else 0) for joint, cost in roots.items()}
    met = {meeting: _TRUNK_MEETING if names[meeting].words & _TRUNK else _MEETING} if meeting >= 0 else {}
    return _cheapest(met | roots | named)


def _cheapest(candidates: Mapping[int, float]) -> int | None:
    return min(candidates, key=lambda joint: (candidates[joint], joint), default=None)


def _neck_and_head(names: Sequence[JointName], parents: Sequence[int], found: Mapping[str, int]) -> dict[str, int]:
    """Return neck and head that names do not tell, as parts of a spine that goes on above the arms."""
    arm = next((part for part in ("collar", "shoulder") if f"l_{part}" in found and f"r_{part}" in found), None)
    if arm is None or "pelvis" not in found or ("neck" in found and "head" in found):
        return {}
    chest = common_ancestor(found[f"l_{arm}"], found[f"r_{arm}"], parents)
    if chest < 0 or chest in path_up(found["pelvis"], parents):
        return {}
    if "head" in found:
        path = path_up(found["head"], parents)
        neck = path[path.index(chest) - 1] if chest in path else found["head"]
        return {} if neck == found["head"] or names[neck].doubt > _MAX_DOUBT or names[neck].side else {"neck": neck}
    path = [found.get("neck", chest)]
    arms = {joint for side in "lr" for joint in path_up(found[f"{side}_{arm}"], parents)}
    # a parent comes before its children
    for joint in range(path[0] + 1, len(names)):
        if parents[joint] == path[-1] and joint not in arms and _is_trunk(names[joint]):
            path.append(joint)
    del path[0]
    parts = {"head": path[-1]} if path else {}
    return parts | ({"neck": path[0]} if len(path) > 1 and "neck" not in found else {})


def _is_trunk(name: JointName) -> bool:
    return bool(name.words & _TRUNK) and not name.side and name.doubt <= _MAX_DOUBT


def spine_between(found: Mapping[str, int], parents: Sequence[int]) -> tuple[int, ...]:
    """Return the joints from pelvis to neck, both excluded, or to the head, collar or shoulder if there is no neck."""
    tops = [found[name] for name in ("neck", "head", "l_collar", "l_shoulder") if name in found]
    if "pelvis" not in found or not tops:
        return ()
    chain = path_up(tops[0], parents)[1:]
    if found["pelvis"] in chain:
        chain = chain[: chain.index(found["pelvis"])]
    else:  # the pelvis is beside the spine, as another child of a common ancestor
        above = set(path_up(found["pelvis"], parents))
        chain = [joint for joint in chain if joint not in above]
    return tuple(joint for joint in reversed(chain) if joint not in found.values())
