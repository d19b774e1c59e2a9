"""Names of joints as other programs use them, so that the animations of those programs fit an exported skeleton.

Sources: Adobe Mixamo's rigs, the mannequins of Unreal Engine 4 and 5, and VRM 1.0 (humanoid bones).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from snarfcli.errors import UserError
from snarfcli.motions.joint_names import BodyParts, find_body_parts, plain_name

__all__ = ["NAMINGS", "human_parts", "named_joints", "parts_in_style"]

NAMINGS = ("smpl", "mixamo", "vrm", "unreal")
"""Names that joints can be given."""

_REQUIRED = ("pelvis", *(f"{side}_{part}" for side in "lr" for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")))
_MARK = re.compile(r"^(.*[:|])?(.*)$", re.DOTALL)  # a name space, as in mixamorig:Hips, and the name
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")

_MIXAMO = {
    "pelvis": "Hips", "neck": "Neck", "head": "Head", "jaw": "Jaw", "hip": "UpLeg", "knee": "Leg", "ankle": "Foot",
    "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "eye": "Eye",
    "hand": "HandMiddle1",
    **{f"{finger}{number}": f"Hand{finger.title()}{number}" for finger in _FINGERS for number in (1, 2, 3)},
}  # fmt: skip
_UNREAL = {
    "pelvis": "pelvis", "neck": "neck_01", "head": "head", "jaw": "jaw", "hip": "thigh", "knee": "calf", "ankle": "foot",
    "foot": "ball", "collar": "clavicle", "shoulder": "upperarm", "elbow": "lowerarm", "wrist": "hand", "eye": "eye",
    "hand": "middle_01",
    **{f"{finger}{number}": f"{finger}_0{number}" for finger in _FINGERS for number in (1, 2, 3)},
}  # fmt: skip
_VRM = {
    "pelvis": "hips", "neck": "neck", "head": "head", "jaw": "jaw", "hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot",
    "foot": "Toes", "collar": "Shoulder", "shoulder": "UpperArm", "elbow": "LowerArm", "wrist": "Hand", "eye": "Eye",
    "hand": "MiddleProximal",
    **{
        f"{finger}{number}": f"{'Little' if finger == 'pinky' else finger.title()}{segment}"
        for finger in _FINGERS
        for number, segment in enumerate(
            ("Metacarpal", "Proximal", "Distal") if finger == "thumb" else ("Proximal", "Intermediate", "Distal"), 1
        )
    },
}  # fmt: skip
_VRM_SPINE = ("spine", "chest", "upperChest")


def named_joints(names: Sequence[str], parents: Sequence[int], style: str | None) -> tuple[str, ...]:
    """Return the joint names of a human skeleton as another program uses them.

    Args:
        names: J unique names, from which the parts of the body are recognised.
        parents: J parents, -1 for a root; a parent comes before its children.
        style: one of `NAMINGS`; None returns the names as they are.

    Returns:
        J unique names. Joints without a counterpart keep their names, with a mark `extra_` where these would be mistaken for
        another joint. Joints NAME_end, which were End Sites of a BVH file, follow their parents.

    Raises:
        UserError: the skeleton is not human; the message names the parts that are missing.
    """
    if style is None:
        return tuple(names)
    parts = human_parts(names, parents, f"names={style}", "leave names out")
    renamed = {joint: name for name, joint in parts_in_style(parts, style).items()}
    plain = {plain_name(name) for name in renamed.values()}
    taken = set(renamed.values())
    result: list[str] = []
    for joint, (name, parent) in enumerate(zip(names, parents, strict=True)):
        if joint in renamed:
            result.append(renamed[joint])
            continue
        if parent >= 0 and name.startswith(f"{names[parent]}_end"):
            name = result[parent] + name[len(names[parent]) :]
        while name in taken or plain_name(name) in plain:
            name = _MARK.sub(r"\1extra_\2", name)
        taken.add(name)
        result.append(name)
    return tuple(result)


def parts_in_style(parts: BodyParts, style: str) -> dict[str, int]:
    """Return the joints of a human body by their names in a style; the spine is numbered from below."""
    found: dict[str, int] = {}
    joints = dict(parts.joints)
    for side in "lr":  # a joint of the fingers may stand for the hand too: the finger is more exact
        if any(joints.get(f"{side}_hand") == joint for part, joint in joints.items() if part != f"{side}_hand"):
            del joints[f"{side}_hand"]
    for part, joint in joints.items():
        found[_part_name(part, style)] = joint
    names = _spine_names(len(parts.spine), style)
    found |= {name: joint for name, joint in zip(names, parts.spine, strict=True) if name}
    return found


def human_parts(names: Sequence[str], parents: Sequence[int], setting: str, otherwise: str) -> BodyParts:
    """Return the parts of a human skeleton.

    Raises:
        UserError: the skeleton is not human. The message names `setting` and what to do `otherwise`.
    """
    parts = find_body_parts(names, parents)
    missing = [part for part in _REQUIRED if part not in parts.joints]
    missing += [] if parts.spine else ["spine"]
    if missing:
        shown = ", ".join(missing[:6]) + (f" and {len(missing) - 6} more" if len(missing) > 6 else "")
        raise UserError(f"{setting}: wanted the skeleton of a human, got one without {shown}; {otherwise}")
    return parts


def _part_name(part: str, style: str) -> str:
    """Return the name of a part such as l_knee in a style."""
    if style == "smpl":
        return part
    side, _, rest = part.partition("_") if part[:2] in ("l_", "r_") else ("", "", part)
    if style == "mixamo":
        return "mixamorig:" + {"l": "Left", "r": "Right", "": ""}[side] + _MIXAMO[rest]
    if style == "unreal":
        return _UNREAL[rest] + (f"_{side}" if side else "")
    return {"l": "left", "r": "right", "": ""}[side] + _VRM[rest]


def _spine_names(count: int, style: str) -> list[str]:
    """Return the names of the joints of the spine, from below; empty for joints without a counterpart."""
    if style == "smpl":
        return [f"spine{number}" for number in range(1, count + 1)]
    if style == "mixamo":
        return ["mixamorig:Spine", *(f"mixamorig:Spine{number}" for number in range(1, count))]
    if style == "unreal":
        return [f"spine_{number:02d}" for number in range(1, count + 1)]
    names = [""] * count
    picks = (0, count // 2, count - 1) if count >= 3 else range(count)
    for name, pick in zip(_VRM_SPINE, picks, strict=False):
        names[pick] = name
    return names
