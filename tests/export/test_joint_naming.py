"""Names of joints as other programs use them, and read back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_human import ToyHuman

from snarfcli.bodies import SMPL_JOINT_NAMES, SMPLX_JOINT_NAMES, Skeleton
from snarfcli.errors import UserError
from snarfcli.export.bvh import export_bvh
from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.export import export_character
from snarfcli.export.joint_naming import NAMINGS, named_joints
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.anatomy import PARENTS
from snarfcli.motions.joint_names import find_body_parts
from snarfcli.motions.reader import average_skeleton

SMPLX_PARENTS = (
    *PARENTS[:22], 15, 15, 15,
    *(wrist if at % 3 == 0 else 24 + 15 * (wrist - 20) + at for wrist in (20, 21) for at in range(15)),
)  # fmt: skip
MIXAMO = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "l_collar": "LeftShoulder", "l_shoulder": "LeftArm", "l_elbow": "LeftForeArm", "l_wrist": "LeftHand",
    "r_hip": "RightUpLeg", "r_knee": "RightLeg", "r_ankle": "RightFoot", "r_foot": "RightToeBase",
}  # fmt: skip
UNREAL = {
    "pelvis": "pelvis", "spine1": "spine_01", "spine3": "spine_03", "neck": "neck_01", "head": "head",
    "l_collar": "clavicle_l", "l_shoulder": "upperarm_l", "l_elbow": "lowerarm_l", "l_wrist": "hand_l",
    "r_hip": "thigh_r", "r_knee": "calf_r", "r_ankle": "foot_r", "r_foot": "ball_r",
}  # fmt: skip
VRM = {
    "pelvis": "hips", "spine1": "spine", "spine2": "chest", "spine3": "upperChest", "neck": "neck", "head": "head",
    "l_collar": "leftShoulder", "l_shoulder": "leftUpperArm", "l_elbow": "leftLowerArm", "l_wrist": "leftHand",
    "r_hip": "rightUpperLeg", "r_knee": "rightLowerLeg", "r_ankle": "rightFoot", "r_foot": "rightToes",
}  # fmt: skip
FINGERS = {
    "mixamo": ("mixamorig:LeftHandPinky2", "mixamorig:RightHandThumb1", "mixamorig:Jaw", "mixamorig:RightEye"),
    "unreal": ("pinky_02_l", "thumb_01_r", "jaw", "eye_r"),
    "vrm": ("leftLittleIntermediate", "rightThumbMetacarpal", "jaw", "rightEye"),
    "smpl": ("l_pinky2", "r_thumb1", "jaw", "r_eye"),
}


@pytest.mark.parametrize(
    ("style", "wanted"), [("mixamo", {k: f"mixamorig:{v}" for k, v in MIXAMO.items()}), ("unreal", UNREAL), ("vrm", VRM)]
)
@pytest.mark.parametrize("skeleton", [(SMPL_JOINT_NAMES, PARENTS), (SMPLX_JOINT_NAMES, SMPLX_PARENTS)], ids=["smpl", "smplx"])
def test_bodies_get_the_names_of_the_program(skeleton, style, wanted):
    names, parents = skeleton
    found = dict(zip(names, named_joints(names, parents, style), strict=True))
    assert {part: found[part] for part in wanted} == wanted
    assert len(set(found.values())) == len(names)
    if len(names) > 24:
        assert tuple(found[part] for part in ("l_pinky2", "r_thumb1", "jaw", "r_eye")) == FINGERS[style]


@pytest.mark.parametrize("style", NAMINGS)
def test_the_names_are_recognised_again(style):
    names, parents = SMPL_JOINT_NAMES, PARENTS
    own, found = find_body_parts(names, parents), find_body_parts(named_joints(names, parents, style), parents)
    without_hands = {part: joint for part, joint in own.joints.items() if part[2:] != "hand"}
    assert {part: found.joints.get(part) for part in without_hands} == without_hands
    assert found.spine == own.spine
    again = named_joints(named_joints(names, parents, style), parents, "smpl")
    assert again[:22] == names[:22]  # the hands are where the middle fingers begin, and take their names


def test_any_human_can_be_renamed():
    names = ("Root", "Hips", "LowerBack", "Neck", "Head", "Tail", "LeftHand", "l_hand_prop")
    names += tuple(f"{side}{part}" for side in ("Left", "Right") for part in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm"))
    names += ("RightHand", "Head_end")
    at = {name: number for number, name in enumerate(names)}
    above = {
        "Hips": "Root", "LowerBack": "Hips", "Neck": "LowerBack", "Head": "Neck", "Tail": "Hips", "Head_end": "Head",
        "l_hand_prop": "LeftHand", "LeftHand": "LeftForeArm", "RightHand": "RightForeArm",
    }  # fmt: skip
    for side in ("Left", "Right"):
        above |= {f"{side}UpLeg": "Hips", f"{side}Leg": f"{side}UpLeg", f"{side}Foot": f"{side}Leg"}
        above |= {f"{side}Arm": "LowerBack", f"{side}ForeArm": f"{side}Arm"}
    parents = [at[above[name]] if name in above else -1 for name in names]
    found = dict(zip(names, named_joints(names, parents, "unreal"), strict=True))
    assert found["LowerBack"] == "spine_01"
    assert found["Head_end"] == "head_end"
    assert found["LeftHand"] == "hand_l"
    assert found["Tail"] == "Tail"
    assert found["Root"] == "Root"
    parts = find_body_parts(tuple(found.values()), parents).joints
    assert parts["pelvis"] == at["Hips"]


def test_a_joint_is_not_mistaken_for_another():
    names = (*SMPL_JOINT_NAMES, "mixamorig:Head")
    found = named_joints(names, (*PARENTS, 0), "mixamo")
    assert found[-1] == "mixamorig:extra_Head"
    assert find_body_parts(found, (*PARENTS, 0)).joints["head"] == 15


def test_only_humans_are_renamed():
    dog = ("hips", "tail", "l_front_leg")
    assert named_joints(dog, (-1, 0, 0), None) == dog
    with pytest.raises(UserError) as caught:
        named_joints(dog, (-1, 0, 0), "mixamo")
    message = str(caught.value)
    assert message.startswith("names=mixamo: wanted the skeleton of a human, got one without l_hip, l_knee, l_ankle, ")
    assert message.endswith("; leave names out")
    assert "\n" not in message


@pytest.mark.parametrize("style", ["smpl", "mixamo", "unreal"])
def test_a_motion_under_other_names_comes_back_exactly(tmp_path, style):
    skeleton = average_skeleton()
    motion = builtin_motion("punching", 1, frame_rate=20).slice(stop=6)
    renamed = Skeleton(
        named_joints(skeleton.names, skeleton.parents, style), skeleton.parents, skeleton.joints_rest, torch.zeros(24, 3)
    )
    export_bvh(tmp_path / "a.bvh", motion, renamed)
    toy = ToyHuman()
    options = CharacterOptions(triangles=300, resolution=32, morph_targets=0)
    export_character(toy, tmp_path / "a.glb", [Clip(motion)], options, joint_names=renamed.names)
    for file, off in (("a.bvh", 1e-6), ("a.glb", 1e-4)):  # float32 in glTF
        back = read_motion(tmp_path / file, skeleton)
        np.testing.assert_allclose(back.poses, motion.poses, atol=off)
        np.testing.assert_allclose(back.translation, motion.translation, atol=off)
