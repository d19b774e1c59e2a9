"""Joint names of many programs and data sets, as trees with the right answer, and ways to make them harder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

__all__ = ["CONVENTIONS", "HARDER", "Convention"]

_ARM, _LEG = ("collar", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot")


@dataclass(frozen=True)
class Convention:
    """The joints of a human rig."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    parts: dict[str, int]
    """Joint by SMPL's name of the part; the right answer."""

    def renamed(self, rename: Callable[[str], str]) -> Convention:
        return replace(self, names=tuple(map(rename, self.names)))

    def with_children(self, *ends: str, of: tuple[str, ...] = ()) -> Convention:
        """Return the rig with a child named `<joint><end>` before all others of a joint, of these parts or else of leaves."""
        under = {self.parts[part] for part in of if part in self.parts} or set(range(len(self.names))) - {*self.parents}
        names, parents, places = [], [], []
        for joint, name in enumerate(self.names):
            places.append(len(names))
            names.append(name)
            parents.append(places[self.parents[joint]] if self.parents[joint] >= 0 else -1)
            for end in ends if joint in under else ():
                names.append(name + end)
                parents.append(places[joint])
        return Convention(tuple(names), tuple(parents), {part: places[joint] for part, joint in self.parts.items()})

    def below(self, *roots: str) -> Convention:
        """Return the rig below the last of several new roots, each the parent of the next."""
        count = len(roots)
        parents = [*range(-1, count - 1), *(parent + count for parent in self.parents)]
        return Convention((*roots, *self.names), tuple(parents), {part: joint + count for part, joint in self.parts.items()})

    def beside(self, *others: str) -> Convention:
        """Return the rig with further roots at the end, without children."""
        return replace(self, names=(*self.names, *others), parents=(*self.parents, *[-1] * len(others)))


def _read(line: str) -> Convention:
    sides, trunk, spine, top, arm, leg = (field.strip() for field in line.split(";"))
    names: list[str] = []
    parents: list[int] = []
    parts: dict[str, int] = {}

    def add(text: str, roles: tuple[str, ...], parent: int, side: str = "") -> int:
        left = iter(roles)
        for word in text.split():
            name = word.strip("()[]") if word[0] in "([" else word
            name = name.replace("~", " ").replace("@", side)
            role = None if word[0] in "([" else next(left, None)
            if word == "-":
                continue
            names.append(name + ("]" if "[" in name else ""))
            parents.append(parent)
            parent = parent if word[0] == "[" else len(names) - 1
            if role:
                parts[role] = len(names) - 1
        return parent

    pelvis = add(trunk, ("pelvis",), -1)
    chest = add(spine, (), pelvis)
    add(top, ("neck", "head"), chest)
    for at, word in enumerate(sides.split("/")):
        side = word[0].lower() if word.isascii() else "lr"[at]
        add(arm, tuple(f"{side}_{part}" for part in _ARM), chest, word)
        add(leg, tuple(f"{side}_{part}" for part in _LEG), pelvis, word)
    return Convention(tuple(names), tuple(parents), parts)


_LINES = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").splitlines()
CONVENTIONS = {name: _read(rest) for name, _, rest in (line.partition(": ") for line in _LINES if line[0] != "#")}
"""Rigs by the name of their convention."""

_LIMBS = ("l_hip", "r_hip", "l_knee", "r_knee", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow")
HARDER: dict[str, Callable[[Convention], Convention]] = {
    "prefix": lambda rig: rig.renamed(lambda name: "m_avg_" + name),
    "numbered prefix": lambda rig: rig.renamed(lambda name: "Xyz_rig_01_" + name),
    "glued prefix": lambda rig: rig.renamed(lambda name: "robotarmhead" + name).below("robot"),
    "namespaces": lambda rig: rig.renamed(lambda name: "Scene|Body1:" + name).below("Scene"),
    "suffix": lambda rig: rig.renamed(lambda name: name + "_bind_JNT"),
    "number behind": lambda rig: rig.renamed(lambda name: name + "_0001_jnt").below("Armature"),
    "lower case": lambda rig: rig.renamed(str.lower),
    "upper case": lambda rig: rig.renamed(str.upper),
    "End Sites": lambda rig: rig.with_children("_end"),
    "twist and roll": lambda rig: rig.with_children("_twist_01", "_roll", of=_LIMBS),
    "helpers": lambda rig: rig.with_children("_helper", "_ctrl", "_IK", of=(*_LIMBS, "neck", "head", "pelvis")),
    "controls": lambda rig: rig.beside("ik_foot_root", "ik_foot_l", "ik_hand_gun", "ik_hand_r", "knee_pole_L", "head_target"),
    "roots": lambda rig: rig.below("Armature", "world").beside("Camera", "Light"),
    "face": lambda rig: rig.with_children("_brow_L", "_brow_R", "_lip_upper_L", "_tongue", of=("head",)),
}
"""What other exporters add to a rig."""
