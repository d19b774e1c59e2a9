"""The joints of a human skeleton as VRM's humanoid bones.

Source: VRM Consortium, VRMC_vrm 1.0, humanoid.
"""

from __future__ import annotations

import itertools

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.export.joint_naming import human_parts, parts_in_style

__all__ = ["human_bones"]

_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
_LEG = ("UpperLeg", "LowerLeg", "Foot", "Toes")
_TRUNK = ("hips", "spine", "chest", "upperChest", "neck", "head")
_FINGERS = {
    "Thumb": ("Metacarpal", "Proximal", "Distal"),
    **dict.fromkeys(("Index", "Middle", "Ring", "Little"), ("Proximal", "Intermediate", "Distal")),
}


def _chains() -> list[tuple[str, ...]]:
    """Return the bones from the hips to each end of the body; in VRM each has the one before it as nearest bone above."""
    chains: list[tuple[str, ...]] = [(*_TRUNK, end) for end in ("leftEye", "rightEye", "jaw")]
    for side in ("left", "right"):
        chains.append(("hips", *(side + bone for bone in _LEG)))
        arm = (*_TRUNK[:4], *(side + bone for bone in _ARM))
        chains += [(*arm, *(side + finger + part for part in parts)) for finger, parts in _FINGERS.items()]
    return chains


_CHAINS = _chains()
_REQUIRED = (
    "hips", "spine", "head",
    *(f"{side}{bone}" for side in ("left", "right") for bone in (*_ARM[1:], *_LEG[:3])),
)  # fmt: skip


def human_bones(skeleton: Skeleton) -> dict[str, int]:
    """Return the joints of a skeleton by the names of VRM's humanoid bones.

    Raises:
        UserError: the skeleton is not human, or its bones are connected in another way than VRM requires.
    """
    otherwise = "give format=glb, which takes any skeleton"
    bones = parts_in_style(human_parts(skeleton.names, skeleton.parents, "format=vrm", otherwise), "vrm")
    missing = [bone for bone in _REQUIRED if bone not in bones]
    if missing:
        raise UserError(f"format=vrm: wanted the bones of a human, got none for {', '.join(missing)}; {otherwise}")
    for bone in ("Thumb", "Index", "Middle", "Ring", "Little"):  # a segment needs the one before it
        for side in ("left", "right"):
            parts = [side + bone + part for part in _FINGERS[bone]]
            lacking = next((number for number, part in enumerate(parts) if part not in bones), len(parts))
            for part in parts[lacking:]:
                bones.pop(part, None)
    numbers = {joint: bone for bone, joint in bones.items()}
    for chain in _CHAINS:
        there = [bone for bone in chain if bone in bones]
        for above, bone in itertools.pairwise(there):
            joint = skeleton.parents[bones[bone]]
            while joint >= 0 and joint not in numbers:
                joint = skeleton.parents[joint]
            if numbers.get(joint) != above:
                lower, upper = (skeleton.names[bones[name]] for name in (bone, above))
                got = skeleton.names[joint] if joint >= 0 else "nothing"
                raise UserError(f"format=vrm: wanted {lower} ({bone}) below {upper} ({above}), got it below {got}; {otherwise}")
    return bones
