"""A person, an animal or a thing: told by the places of the joints alone."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_animal import make_animal
from toy_rigs import CMU_NAMES, a_pose, rig_of

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.errors import UserError
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS, joint_positions
from snarfcli.motions.mapping import map_joints
from snarfcli.motions.tree_shape import find_by_shape

SMPL = Skeleton(SMPL_JOINT_NAMES, PARENTS, torch.as_tensor(JOINTS_REST), torch.zeros(24, 3))
TOLD = [name for name in SMPL_JOINT_NAMES if name not in ("spine1", "spine2", "spine3", "l_hand", "r_hand")]
NUMBERED = tuple(f"bone_{number:02}" for number in range(24))


def nameless(names=NUMBERED, **options):
    return rig_of(np.zeros((1, 24, 3)), np.zeros((1, 3)), names, **options)


def mapped(rig, **options):
    return map_joints(SMPL, rig, Path("walk.bvh"), **options)


@pytest.mark.parametrize("rest", ["t_pose", "a_pose"])
@pytest.mark.parametrize("turn", [(0, 0, 0), (90, 0, 0), (0, 130, 0), (20, -70, 160)])
def test_a_person_in_any_direction_and_unit(rest, turn):
    points = joint_positions((a_pose() if rest == "a_pose" else np.zeros((24, 3)))[None], np.zeros((1, 3)))[0][0]
    points = 100 * Rotation.from_euler("xyz", turn, degrees=True).apply(points) + [5, -300, 8]
    shape = find_by_shape(PARENTS, points, set())
    assert shape is not None
    assert shape.has_sides
    assert shape.joints == {name: SMPL_JOINT_NAMES.index(name) for name in TOLD}


def test_a_person_among_other_joints():
    """A root, something carried, short chains of hair, an eye on each side, a muscle beside each thigh."""
    parents, points = [-1, *(parent + 1 for parent in PARENTS)], [np.zeros(3), *(JOINTS_REST + np.array([0, 1, 0]))]
    hair, eye, carried, muscle = [0, 0.1, -0.1], [0.03, 0.1, 0.1], [0, 0.1, 0], [0, -0.2, 0]
    more = [
        ("head", hair),
        ("head", eye),
        ("head", [-0.03, 0.1, 0.1]),
        ("l_hand", carried),
        ("l_hip", muscle),
        ("r_hip", muscle),
    ]
    for part, offset in more:
        above = SMPL_JOINT_NAMES.index(part) + 1
        parents.append(above)
        points.append(points[above] + offset)
    shape = find_by_shape(parents, np.array(points), set())
    assert shape is not None
    assert shape.joints == {name: SMPL_JOINT_NAMES.index(name) + 1 for name in TOLD}


def grown(chains):
    """Return parents and points of a tree; a chain is the place of its parent joint and the offsets of its bones."""
    parents, points = [-1], [np.zeros(3)]
    for parent, *offsets in chains:
        for offset in offsets:
            parents.append(parent)
            points.append(points[parent] + offset)
            parent = len(points) - 1
    return parents, np.array(points, float)


def pair(parent, *offsets):
    return [(parent, *offsets), (parent, *[(-x, y, z) for x, y, z in offsets])]


LEG, ARM = [(1, 0, 0), (0, -4, 0), (0, -4, 0), (0, -0.5, 1)], [(1, 0, 0), (3, 0, 0), (3, 0, 0), (1, 0, 0)]
HEAD, SPINE, TAIL = [(0, 1, 0), (0, 1, 0), (0, 1, 0)], [(0, 2.5, 0), (0, 2.5, 0)], [(0, 0, -3), (0, 0, -3)]
NO_PERSON = {
    "quadruped": grown([(0, (0, 0, 3), (0, 0, 3)), (2, (0, 1, 1), (0, 1, 1)), *pair(0, *LEG), *pair(2, *LEG)]),
    "chair": grown([(0, (0, 5, 0)), *pair(0, (2, 0, 2), (0, -4, 0), (0, -4, 0)), *pair(0, (2, 0, -2), (0, -4, 0), (0, -4, 0))]),
    "chair with arms": grown([(0, (0, 3, 0), (0, 3, 0)), *pair(0, *LEG), *pair(2, (2, 0, 0), (0, 0, 3)), (2, (0, 1, 0))]),
    "with a tail": grown([(0, *SPINE), (0, *TAIL), (2, *HEAD), *pair(0, *LEG), *pair(2, *ARM)]),
    "with wings": grown([(0, *SPINE), (2, *HEAD), *pair(0, *LEG), *pair(2, *ARM), *pair(2, *ARM[:1], *ARM[:3])]),
    "without head": grown([(0, *SPINE), *pair(0, *LEG), *pair(2, *ARM)]),
    "without arms": grown([(0, *SPINE), (2, *HEAD), *pair(0, *LEG)]),
    "one leg shorter": grown([(0, *SPINE), (2, *HEAD), (0, *LEG), (0, (-1, 0, 0), (0, -4, 0), (0, -3, 0)), *pair(2, *ARM)]),
    "long arms": grown([(0, *SPINE), (2, *HEAD), *pair(0, *LEG), *pair(2, *ARM[:1], (6, 0, 0), (6, 0, 0))]),
    "one point": grown([(0, (0, 0, 0), (0, 0, 0)), *pair(0, (0, 0, 0), (0, 0, 0), (0, 0, 0))]),
    "one joint": grown([]),
    "no number": (PARENTS, np.full((24, 3), np.nan)),
    "too large to subtract": (PARENTS, np.sign(JOINTS_REST) * 1.7e308),
    "all bones along x": (PARENTS, np.arange(24)[:, None] * [1.0, 0, 0]),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_PERSON)
def test_what_is_no_person(name):
    assert find_by_shape(*NO_PERSON[name], set()) is None


def test_the_same_parts_make_a_person():
    parents, points = grown([(0, *SPINE), (2, *HEAD), *pair(0, *LEG), *pair(2, *ARM)])
    shape = find_by_shape(parents, points, set())
    assert shape is not None
    assert shape.joints["l_knee"] == 7


def test_animals_and_random_trees_are_no_persons():
    animal = make_animal()
    assert find_by_shape(animal.parents, np.asarray(animal.joints), set()) is None
    rng = np.random.default_rng(0)
    for _ in range(200):
        parents = [-1, *(int(rng.integers(max(at - 4, 0), at)) for at in range(1, 30))]
        assert find_by_shape(parents, rng.normal(size=(30, 3)), set()) is None


def test_a_rig_without_names_is_mapped_and_the_guess_is_told(caplog):
    rig = nameless(rest_pose=a_pose(), scale=100)
    with caplog.at_level(logging.INFO, "snarfcli"):
        pairs = mapped(rig)
    assert pairs == {joint: joint for joint, name in enumerate(SMPL_JOINT_NAMES) if not name.endswith("hand")}
    assert "l_hip: bone_01" in caplog.text
    assert "left and right are guessed from the feet" in caplog.text
    assert "mapping=" in caplog.text


def test_names_that_are_known_decide_the_side(caplog):
    names = [*NUMBERED]
    names[SMPL_JOINT_NAMES.index("l_hip")] = "RightThigh"
    with caplog.at_level(logging.INFO, "snarfcli"):
        pairs = mapped(nameless(tuple(names)))
    assert pairs[SMPL_JOINT_NAMES.index("r_knee")] == SMPL_JOINT_NAMES.index("l_knee")
    assert "guessed from the feet" not in caplog.text


def test_some_names_are_known():
    names = tuple(name if "Leg" in name or name == "Hips" else f"b{at}" for at, name in enumerate(CMU_NAMES))
    pairs = mapped(nameless(names))
    assert pairs == {joint: joint for joint, name in enumerate(SMPL_JOINT_NAMES) if not name.endswith("hand")}


def without_toes():
    rig = nameless()
    rig.rest[[10, 11], :3, 3] = rig.rest[[7, 8], :3, 3] - [0, 0.05, 0]
    return rig


@pytest.mark.parametrize("spoil", [
    without_toes,
    lambda: nameless(tuple("LeftUpLeg" if at == 18 else f"b{at}" for at in range(24))),
    lambda: nameless(tuple({1: "LeftUpLeg", 17: "LeftArm"}.get(at, f"b{at}") for at in range(24))),
], ids=["no toes, no sides", "a thigh that is an elbow", "sides that contradict each other"])  # fmt: skip
def test_a_shape_that_is_not_clear_is_refused(spoil):
    with pytest.raises(UserError, match=r"no joint for .*r_hip.*give mapping=FILE.json") as error:
        mapped(spoil())
    assert "the skeleton has pelvis" in str(error.value)


def test_a_mapping_by_hand_is_not_completed_by_guesses():
    assert mapped(nameless(), mapping={"l_hip": "bone_05"}) == {0: 0, 1: 5}
