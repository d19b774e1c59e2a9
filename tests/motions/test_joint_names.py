"""Which joint is what, in the spellings of many programs."""

from __future__ import annotations

import pytest

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.motions.anatomy import PARENTS
from snarfcli.motions.joint_names import find_body_parts, plain_name

# name of a joint and of its parent; of paired joints the left ones
CMU = """Hips -, LHipJoint Hips, LeftUpLeg LHipJoint, LeftLeg LeftUpLeg, LeftFoot LeftLeg, LeftToeBase LeftFoot, LowerBack Hips,
 Spine LowerBack, Spine1 Spine, Neck Spine1, Neck1 Neck, Head Neck1, LeftShoulder Spine1, LeftArm LeftShoulder,
 LeftForeArm LeftArm, LeftHand LeftForeArm, LeftFingerBase LeftHand, LeftHandIndex1 LeftFingerBase, LThumb LeftHand"""
MIXAMO = """mixamorig:Hips -, mixamorig:Spine mixamorig:Hips, mixamorig:Spine1 mixamorig:Spine,
 mixamorig:Spine2 mixamorig:Spine1, mixamorig:Neck mixamorig:Spine2, mixamorig:Head mixamorig:Neck,
 mixamorig:HeadTop_End mixamorig:Head, mixamorig:LeftShoulder mixamorig:Spine2, mixamorig:LeftArm mixamorig:LeftShoulder,
 mixamorig:LeftForeArm mixamorig:LeftArm, mixamorig:LeftHand mixamorig:LeftForeArm,
 mixamorig:LeftHandIndex1 mixamorig:LeftHand, mixamorig:LeftHandMiddle1 mixamorig:LeftHand,
 mixamorig:LeftUpLeg mixamorig:Hips, mixamorig:LeftLeg mixamorig:LeftUpLeg, mixamorig:LeftFoot mixamorig:LeftLeg,
 mixamorig:LeftToeBase mixamorig:LeftFoot, mixamorig:LeftToe_End mixamorig:LeftToeBase"""
UNREAL = """root -, pelvis root, spine_01 pelvis, spine_02 spine_01, spine_03 spine_02, neck_01 spine_03, head neck_01,
 clavicle_l spine_03, upperarm_l clavicle_l, upperarm_twist_01_l upperarm_l, lowerarm_l upperarm_l, hand_l lowerarm_l,
 index_01_l hand_l, middle_01_l hand_l, thigh_l pelvis, calf_l thigh_l, foot_l calf_l, ball_l foot_l"""
BIPED = """Bip01 -, Bip01_Pelvis Bip01, Bip01_Spine Bip01_Pelvis, Bip01_Spine1 Bip01_Spine, Bip01_Neck Bip01_Spine1,
 Bip01_Head Bip01_Neck, Bip01_L_Clavicle Bip01_Neck, Bip01_L_UpperArm Bip01_L_Clavicle, Bip01_L_Forearm Bip01_L_UpperArm,
 Bip01_L_Hand Bip01_L_Forearm, Bip01_L_Thigh Bip01_Pelvis, Bip01_L_Calf Bip01_L_Thigh, Bip01_L_Foot Bip01_L_Calf,
 Bip01_L_Toe0 Bip01_L_Foot"""
ASF = """root -, lhipjoint root, lfemur lhipjoint, ltibia lfemur, lfoot ltibia, ltoes lfoot, lowerback root,
 upperback lowerback, thorax upperback, lowerneck thorax, upperneck lowerneck, head upperneck, lclavicle thorax,
 lhumerus lclavicle, lradius lhumerus, lwrist lradius, lhand lwrist, lfingers lhand, lthumb lhand"""
OLD = """Hips -, Chest Hips, Neck Chest, Head Neck, LeftCollar Chest, LeftShoulder LeftCollar, LeftElbow LeftShoulder,
 LeftWrist LeftElbow, LeftHip Hips, LeftKnee LeftHip, LeftAnkle LeftKnee"""


def tree(text):
    pairs = [entry.split() for entry in text.replace("\n", " ").split(",")]
    names = [name for name, _ in pairs]
    return names, [names.index(parent) if parent in names else -1 for _, parent in pairs]


@pytest.mark.parametrize(
    ("text", "expected", "spine"),
    [
        (
            CMU,
            {"pelvis": "Hips", "l_hip": "LeftUpLeg", "l_knee": "LeftLeg", "l_ankle": "LeftFoot", "l_foot": "LeftToeBase",
             "neck": "Neck", "head": "Head", "l_collar": "LeftShoulder", "l_shoulder": "LeftArm", "l_elbow": "LeftForeArm",
             "l_wrist": "LeftHand", "l_hand": "LeftFingerBase", "l_index1": "LeftHandIndex1"},
            ["LowerBack", "Spine", "Spine1"],
        ),
        (
            MIXAMO,
            {"pelvis": "Hips", "l_hip": "LeftUpLeg", "l_knee": "LeftLeg", "l_ankle": "LeftFoot", "l_foot": "LeftToeBase",
             "neck": "Neck", "head": "Head", "l_collar": "LeftShoulder", "l_shoulder": "LeftArm", "l_elbow": "LeftForeArm",
             "l_wrist": "LeftHand", "l_hand": "LeftHandMiddle1", "l_index1": "LeftHandIndex1",
             "l_middle1": "LeftHandMiddle1"},
            ["Spine", "Spine1", "Spine2"],
        ),
        (
            UNREAL,
            {"pelvis": "pelvis", "l_hip": "thigh_l", "l_knee": "calf_l", "l_ankle": "foot_l", "l_foot": "ball_l",
             "neck": "neck_01", "head": "head", "l_collar": "clavicle_l", "l_shoulder": "upperarm_l",
             "l_elbow": "lowerarm_l", "l_wrist": "hand_l", "l_hand": "middle_01_l", "l_index1": "index_01_l",
             "l_middle1": "middle_01_l"},
            ["spine_01", "spine_02", "spine_03"],
        ),
        (
            BIPED.replace("_", "."),
            {"pelvis": "Bip01.Pelvis", "l_hip": "Bip01.L.Thigh", "l_knee": "Bip01.L.Calf", "l_ankle": "Bip01.L.Foot",
             "l_foot": "Bip01.L.Toe0", "neck": "Bip01.Neck", "head": "Bip01.Head", "l_collar": "Bip01.L.Clavicle",
             "l_shoulder": "Bip01.L.UpperArm", "l_elbow": "Bip01.L.Forearm", "l_wrist": "Bip01.L.Hand"},
            ["Bip01.Spine", "Bip01.Spine1"],
        ),
        (
            ASF,
            {"pelvis": "root", "l_hip": "lfemur", "l_knee": "ltibia", "l_ankle": "lfoot", "l_foot": "ltoes",
             "neck": "lowerneck", "head": "head", "l_collar": "lclavicle", "l_shoulder": "lhumerus", "l_elbow": "lradius",
             "l_wrist": "lwrist", "l_hand": "lhand"},
            ["lowerback", "upperback", "thorax"],
        ),
        (
            OLD,
            {"pelvis": "Hips", "l_hip": "LeftHip", "l_knee": "LeftKnee", "l_ankle": "LeftAnkle", "neck": "Neck",
             "head": "Head", "l_collar": "LeftCollar", "l_shoulder": "LeftShoulder", "l_elbow": "LeftElbow",
             "l_wrist": "LeftWrist"},
            ["Chest"],
        ),
    ],
    ids=["cmu", "mixamo", "unreal", "biped", "asf", "old"],
)  # fmt: skip
def test_programs_names(text, expected, spine):
    names, parents = tree(text)
    parts = find_body_parts(names, parents)
    prefix = "mixamorig:" if text is MIXAMO else ""
    assert {part: names[joint].removeprefix(prefix) for part, joint in parts.joints.items()} == expected
    assert [names[joint].removeprefix(prefix) for joint in parts.spine] == spine


@pytest.mark.parametrize(
    "spell",
    [
        str, str.upper, lambda name: name.replace("l_", "left_").replace("r_", "right_"),
        lambda name: name.replace("l_", "L_", 1).title(), lambda name: "smpl|" + name,
        lambda name: name[2:] + "." + name[0].upper() if name[1] == "_" else name,
        lambda name: {"l_": "Left", "r_": "Right"}.get(name[:2], "") + name.removeprefix("l_").removeprefix("r_").title(),
    ],
)  # fmt: skip
def test_smpl_names_in_many_spellings(spell):
    parts = find_body_parts([spell(name) for name in SMPL_JOINT_NAMES], PARENTS)
    expected = {name: joint for joint, name in enumerate(SMPL_JOINT_NAMES) if not name.startswith("spine")}
    assert parts.joints == expected
    assert parts.spine == (3, 6, 9)


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("LHipJoint", "l_hipjoint"), ("mixamorigLeftArm", "l_arm"), ("mixamorig1:RightHand", "r_hand"), ("thigh.L", "l_thigh"),
        ("DEF-upper_arm.R.001", "r_upperarm1"), ("J_Bip_L_UpperLeg", "l_upperleg"), ("J_Bip_C_Hips", "hips"),
        ("CC_Base_L_Thigh", "l_thigh"), ("Character1_LeftUpLeg", "l_upleg"), ("Bip001 R Foot", "r_foot"),
        ("left_eye_smplhf", "l_eye"), ("lCollar", "l_collar"), ("leftUpLeg", "l_upleg"), ("Armature|mixamorig:Hips", "hips"),
        ("left_index1", "l_index1"), ("L_Hip", "l_hip"), ("ring_02_r", "r_ring2"), ("rradius", "r_radius"), ("root", "root"),
        ("", ""), ("1", "1"), ("l", "l"), ("ring1", "ring1"), ("legs", "legs"), ("日本", ""),
    ],
)  # fmt: skip
def test_plain_names(name, plain):
    assert plain_name(name) == plain


def test_what_is_no_body():
    parts = find_body_parts(["body", "wheel", "door"], [-1, 0, 0])
    assert parts.joints == {}
    assert parts.spine == ()
    assert find_body_parts([], []).joints == {}


def test_a_pelvis_beside_the_spine():
    names, parents = ["all", "hips", "thigh_l", "spine", "chest", "neck"], [-1, 0, 1, 0, 3, 4]
    assert find_body_parts(names, parents).spine == (3, 4)
