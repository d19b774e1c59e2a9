"""The joints of a person in the names of many programs, data sets and games, with what exporters add to them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from name_conventions import CONVENTIONS, HARDER

from snarfcli.motions.joint_names import REQUIRED_PARTS, find_body_parts

SIDED = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
PARTS = ("pelvis", "neck", "head", *(f"{side}_{part}" for side in "lr" for part in SIDED))


def found(rig):
    joints = find_body_parts(rig.names, rig.parents).joints
    return {part: rig.names[joints[part]] for part in PARTS if part in joints}


def right(rig):
    return {part: rig.names[rig.parts[part]] for part in PARTS if part in rig.parts}


def test_there_are_many_conventions():
    assert len(CONVENTIONS) >= 60
    assert all(part in rig.parts for rig in CONVENTIONS.values() for part in REQUIRED_PARTS)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_convention(name):
    assert found(CONVENTIONS[name]) == right(CONVENTIONS[name])


@pytest.mark.parametrize("way", HARDER)
def test_with_what_exporters_add(way):
    wrong = {}
    for name, convention in CONVENTIONS.items():
        rig = HARDER[way](convention)
        if found(rig) != right(rig):
            wrong[name] = {*found(rig).items()} ^ {*right(rig).items()}
    assert wrong == {}


def test_names_decide_where_the_tree_is_flat():
    rig = CONVENTIONS["cmu"]
    flat = replace(rig, parents=(-1, *[0] * (len(rig.names) - 1)))
    assert found(flat) == right(flat)


def test_rigifys_deform_bones_beside_its_controls():
    rig = CONVENTIONS["rigify"]
    copies = [name.replace("DEF-", start) for start in ("ORG-", "MCH-", "") for name in rig.names]
    controls = ["root", "torso", "hips", "chest", "neck", "head", "thigh_ik.L", "thigh_fk.L", "foot_ik.L", "upper_arm_parent.L"]
    count = len(rig.names)
    parents = [parent + at * count if parent >= 0 else -1 for at in range(3) for parent in rig.parents]
    names = (*copies, *controls, *rig.names)
    offset = len(names) - count
    parents += [-1] * len(controls) + [parent + offset if parent >= 0 else -1 for parent in rig.parents]
    mixed = replace(rig, names=names, parents=tuple(parents), parts={part: joint + offset for part, joint in rig.parts.items()})
    assert found(mixed) == right(mixed)


def test_the_spine_of_rigify():
    rig = CONVENTIONS["rigify"]
    spine = find_body_parts(rig.names, rig.parents).spine
    assert [rig.names[joint] for joint in spine] == ["DEF-spine.001", "DEF-spine.002", "DEF-spine.003"]


@pytest.mark.parametrize("names", [
    ["seat", "back", "arm_L", "arm_R", "leg_front_L", "leg_front_R", "leg_back_L", "leg_back_R"],
    ["Torso", "Head", "Left Arm", "Right Arm", "Left Leg", "Right Leg"],
    ["root", "spine", "head", "front_thigh.L", "front_shin.L", "front_foot.L", "thigh.L", "shin.L", "thigh.R", "shin.R"],
    [f"bone_{number:02}" for number in range(24)],
    [str(number) for number in range(24)],
])  # fmt: skip
def test_what_is_no_person_by_its_names(names):
    assert find_body_parts(names, [-1] + [0] * (len(names) - 1)).missing
