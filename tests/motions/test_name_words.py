"""Words, sides and numbers in joint names."""

from __future__ import annotations

import pytest

from snarfcli.motions.name_words import read_names


@pytest.mark.parametrize(
    ("name", "side", "words", "numbers"),
    [
        ("lThighBend", "l", "thigh", ()), ("thigh.L", "l", "thigh", ()), ("Thigh_Left", "l", "thigh", ()),
        ("left thigh", "l", "thigh", ()), ("LThigh", "l", "thigh", ()), ("HipRight", "r", "hip", ()), ("r-hip", "r", "hip", ()),
        ("RUArm", "r", "upper arm", ()), ("lfarm", "l", "fore arm", ()), ("LEFTUPLEG", "l", "upper leg", ()),
        ("leftupleg", "l", "upper leg", ()), ("rradius", "r", "radius", ()), ("upper_arm.R.001", "r", "upper arm", (1,)),
        ("左足首", "l", "ankle", ()), ("右足", "r", "leg", ()), ("人指１.L", "l", "index", (1,)),
        ("上半身2", "", "spine", (2,)),
        ("toe1-1.L", "l", "toe", (1, 1)), ("L_toeBase", "l", "toe base", ()), ("LLeg_Calf", "l", "shin", ()),
        ("NPC L Foot [Lft ]", "l", "foot", ()), ("SpineBase", "", "spine", ()), ("LowerTorso", "", "lower torso", ()),
        ("LeftFootAnkle", "l", "ankle", ()), ("LeftHandIndex1", "l", "index", (1,)), ("legs", "", "", ()),
        ("rear", "", "rear", ()),
        ("C_Hips", "", "hip", ()), ("", "", "", ()), ("🙂", "", "", ()), ("_:|", "", "", ()), ("l" * 10**5, "", "", ()),
    ],
)  # fmt: skip
def test_words(name, side, words, numbers):
    read = read_names([name])[0]
    assert (read.side, set(read.words), read.numbers) == (side, set(words.split()), numbers)


def test_doubt():
    clear, aside, unknown, control = (
        name.doubt for name in read_names(["LeftArm", "LeftArmTwist", "LeftArmour Arm", "LeftArmIK"])
    )
    assert clear == 0 < unknown < aside < control == float("inf")


def test_what_most_names_have_in_common_is_left_out():
    names = ["head_l_hip_v2", "head_r_hip_v2", "head_l_knee_v2", "head_r_knee_v2", "head_head_v2", "other"]
    read = read_names(names)
    assert [(name.side, *name.words, *name.numbers) for name in read[:5]] == [
        ("l", "hip"), ("r", "hip"), ("l", "knee"), ("r", "knee"), ("", "head"),
    ]  # fmt: skip
    assert {name.doubt for name in read[:5]} == {0}
    assert read_names([]) == []
