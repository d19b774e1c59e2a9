"""Checks of settings: which values pass, and the messages for others."""

from __future__ import annotations

import math

import pytest

from snarfcli.checks import alternatives, check_choice, check_number, check_positive
from snarfcli.errors import UserError


def test_choices_are_listed_with_the_most_similar_one():
    assert alternatives(["a"]) == "a"
    assert alternatives(("a", "b", "c")) == "a, b or c"
    check_choice("format", "ply", ("ply", "obj"))
    with pytest.raises(UserError, match=r"^format: wanted ply or obj, got 'pyl'; did you mean 'ply'\?$"):
        check_choice("format", "pyl", ("ply", "obj"))


def test_numbers_have_bounds_and_are_finite():
    for value in (None, 0, 1.0):
        check_number("share", value, 0, 1)
    with pytest.raises(UserError, match=r"^share: wanted 0 to 1, got 1.5$"):
        check_number("share", 1.5, 0, 1)
    for value in (0, math.nan, math.inf):
        with pytest.raises(UserError, match=f"^steps: wanted at least 1, got {value}$"):
            check_number("steps", value, 1)


def test_positive_numbers_are_finite_and_not_0():
    for value in (None, 1e-9):
        check_positive("tolerance", value)
    for value in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UserError, match=f"^tolerance: wanted a positive number, got {value}$"):
            check_positive("tolerance", value)
