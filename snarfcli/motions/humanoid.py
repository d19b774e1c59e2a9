"""The parts of a human body that a VRM file names itself, whatever its joints are called.

Source: VRM Consortium, VRMC_vrm 1.0, humanoid (names and order of the bones).
"""

from __future__ import annotations

from snarfcli.formats.rig import Rig
from snarfcli.motions.joint_names import BodyParts

__all__ = ["humanoid_parts"]

_SPINE = ("spine", "chest", "upperChest")
_MIDDLE = {"pelvis": "hips", "neck": "neck", "head": "head", "jaw": "jaw"}
# SMPL's hand joints are at the knuckles, where the middle finger begins.
_SIDED = {
    "hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot", "foot": "Toes", "collar": "Shoulder", "shoulder": "UpperArm",
    "elbow": "LowerArm", "wrist": "Hand", "eye": "Eye", "hand": "MiddleProximal",
}  # fmt: skip
_FINGERS = {"index": "Index", "middle": "Middle", "pinky": "Little", "ring": "Ring", "thumb": "Thumb"}
_PHALANGES = ("Proximal", "Intermediate", "Distal")
_THUMB_BONES = ("Metacarpal", "Proximal", "Distal")


def humanoid_parts(rig: Rig) -> BodyParts | None:
    """Return the joints of a rig by parts of the body, from its table of bones; None if it has no such table."""
    if not rig.humanoid:
        return None
    bones = dict(_MIDDLE)
    for side, long in (("l", "left"), ("r", "right")):
        bones |= {f"{side}_{part}": long + bone for part, bone in _SIDED.items()}
        for finger, bone in _FINGERS.items():
            ends = _THUMB_BONES if finger == "thumb" else _PHALANGES
            bones |= {f"{side}_{finger}{number}": f"{long}{bone}{end}" for number, end in enumerate(ends, 1)}
    joints = {part: rig.humanoid[bone] for part, bone in bones.items() if bone in rig.humanoid}
    return BodyParts(joints, tuple(rig.humanoid[bone] for bone in _SPINE if bone in rig.humanoid))
