"""The example with questions: the answers of an avatar agree with each other."""

from __future__ import annotations

import pytest
import questions
from tiny_avatars import tiny_avatar


@pytest.fixture(scope="module")
def avatar():
    return tiny_avatar("voxel")


def test_the_answers_fit_together(avatar):
    facts = questions.answers(avatar)
    assert 50 < facts["points inside"] < questions.POINTS / 2
    assert facts["roots"] > facts["points inside"]
    assert facts["largest distance in mm"] < 0.1  # the tolerance of the search, of a box of 0.9 m
    assert facts["mean change of volume"] == pytest.approx(1, abs=0.2)
    assert 5 < facts["volume in litres"] < 100  # a capsule of 0.7 m


def test_each_joint_has_a_bone(avatar):
    bones = questions.heaviest_bones(avatar)
    assert set(bones) == set(avatar.skeleton.names)
    assert all(text.split(" ")[0] in avatar.skeleton.names for text in bones.values())
