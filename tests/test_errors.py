"""Messages of user errors."""

from __future__ import annotations

from snarfcli.errors import nearest, one_line


def test_one_line_has_neither_line_breaks_nor_control_characters():
    assert one_line("  a\n\n b\x1b[31m\tc ") == "a b [31m c"
    assert one_line(ValueError("bad\nvalue")) == "bad value"
    assert one_line(ValueError()) == "ValueError"


def test_one_line_is_cut_only_where_a_limit_is_given():
    assert len(one_line("x" * 1000)) == 1000
    assert one_line("x" * 1000, 200) == "x" * 200


def test_the_nearest_name_is_offered():
    assert nearest("fast_snraf", ["snarf", "fast_snarf"]) == "; did you mean 'fast_snarf'?"
    assert nearest("zzz", ["snarf"]) == ""
