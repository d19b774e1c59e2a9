"""Helpers for the messages of user errors."""

from __future__ import annotations

from snarfcli.errors import nearest


def test_the_nearest_name_is_offered():
    assert nearest("fast_snraf", ["snarf", "fast_snarf"]) == "; did you mean 'fast_snarf'?"
    assert nearest("zzz", ["snarf"]) == ""
