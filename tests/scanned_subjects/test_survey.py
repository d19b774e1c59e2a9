"""Unit, up axis, floor and other things, from some frames of each sequence."""

from __future__ import annotations

import numpy as np
import pytest
from toy_scans import Z_UP, floor, person, together

from snarfcli.errors import UserError
from snarfcli.scanned_subjects.survey import Sample, survey_samples

BODY_M = 1.75


def survey(*clouds, scale="auto", up="auto", sequences=None):
    samples = [Sample((sequences or [0] * 9)[number], number, *cloud) for number, cloud in enumerate(clouds)]
    return survey_samples(samples, ["walk", "run"], BODY_M, scale, up)


@pytest.mark.parametrize(("unit", "name"), [(1.0, "m"), (0.01, "cm"), (0.001, "mm")])
def test_the_unit_is_guessed(unit, name):
    points, normals = person()
    found = survey((points / unit, normals))
    assert found.scale == unit
    assert f"the files are in {name}: 1.7" in found.facts[0]
    assert found.up == "y"
    assert not found.floors
    assert not found.others


def test_a_unit_that_cannot_be_guessed_is_an_error_unless_it_is_given():
    points, normals = person()
    with pytest.raises(
        UserError, match=r"unit of the scans cannot be guessed: wanted a longest side of 0\.6125 to 2\.712 \(m\)"
    ):
        survey((points / 0.12, normals))
    assert survey((points / 0.12, normals), scale="0.12").scale == 0.12


def test_the_up_axis_is_that_of_a_floor_else_of_the_longest_side():
    points, normals = person()
    assert survey((points @ Z_UP.T, normals @ Z_UP.T)).up == "z"
    assert survey((points @ Z_UP.T, normals @ Z_UP.T), up="y").up == "y"
    on_floor = together((points @ Z_UP.T, normals @ Z_UP.T), floor(-0.3, side=3.0))  # lying on a floor with y up
    found = survey(on_floor)
    assert found.up == "y"
    assert "the scans show a floor" in " ".join(found.facts)
    once = survey((points @ Z_UP.T, normals @ Z_UP.T), on_floor, (points @ Z_UP.T, normals @ Z_UP.T))
    assert (once.up, once.floors) == ("z", {})  # one frame that seems to show a floor does not decide for all
    crouching = points * [1, 0.4, 1.8]
    assert survey((crouching, normals), scale="1").up is None


def test_a_floor_belongs_to_its_sequence():
    body = person()
    lowest = body[0][:, 1].min()
    found = survey(body, together(body, floor(lowest)), together(body, floor(lowest)), sequences=[0, 1, 1])
    assert set(found.floors) == {1}
    assert "left out: a floor, in run" in found.facts
    once = survey(body, body, together(body, floor(lowest)), sequences=[1, 1, 1])
    assert not once.floors


def test_a_second_person_and_a_thing_are_told_apart():
    points, normals = person()
    small = (0.2 * points[:300] + np.array([1.5, 0, 0]), normals[:300])
    found = survey(together((points, normals), small))
    assert found.has_parts == {0}
    assert not found.others
    assert "left out: things apart from the subject, up to 0.3" in found.facts[-2]
    two = survey(together((points, normals), (points + np.array([1.9, 0, 0]), normals)))
    assert [len(cloud[0]) for cloud in two.others] == [3000]
