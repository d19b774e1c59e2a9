"""Texts that are made safe for messages, terminals and pages."""

from __future__ import annotations

import html
import re

from snarfcli.texts import counted, html_text, markdown_text, one_line, plain_markdown, terminal_text

HOSTILE = "a\x1b]0;title\x07\x1b[2J\r\u202eb\u2028\x9b31m\ud800"


def test_counts_agree_with_their_nouns():
    assert [counted(count, "frame") for count in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert [counted(count, "mesh", "meshes") for count in (1, 2)] == ["1 mesh", "2 meshes"]


def test_one_line_has_neither_line_breaks_nor_control_characters():
    assert one_line("  a\n\n b\x1b[31m\tc ") == "a b [31m c"
    assert one_line(ValueError("bad\nvalue")) == "bad value"
    assert one_line(ValueError()) == "ValueError"


def test_one_line_is_cut_only_where_a_limit_is_given():
    assert len(one_line("x" * 1000)) == 1000
    assert one_line("x" * 1000, 200) == "x" * 200


def test_text_on_a_terminal_keeps_its_lines_and_shows_control_characters():
    assert terminal_text("größe: 1\n\t2") == "größe: 1\n\t2"
    shown = terminal_text(HOSTILE)
    assert all(letter.isprintable() for letter in shown)
    assert shown.startswith("a\\x1b]0;title\\x07\\x1b[2J\\r\\u202eb")
    shown.encode()


def test_no_mark_up_is_left_in_text_for_a_page_and_its_characters_are_shown():
    attacks = "<img src=x onerror=alert(1)> {alert(1)} [a](javascript:b) `c` | d | https://e.org/f_g - ~ # *h* &lt; " + HOSTILE
    escaped = markdown_text(attacks, 1000)
    assert re.fullmatch(r"(?:[^\W_]|[ ,]|&#\d+;)*", escaped)
    assert html.unescape(escaped) == one_line(attacks)
    assert len(html.unescape(markdown_text("_" * 10**6))) == 200


def test_plain_markdown_stays_readable_unless_something_in_it_is_mark_up():
    assert plain_markdown("train: loss is NaN (step 7)\n") == "train: loss is NaN (step 7)"
    assert plain_markdown("a <b>") == "a &#60;b&#62;"
    assert plain_markdown("x" * 9, 3) == "xxx"


def test_html_shows_the_characters_of_a_text():
    hostile = "</title><script>alert('x')</script> &amp; \"a\" " + HOSTILE
    safe = html_text(hostile)
    assert not set("<>\"'") & set(safe)
    assert html.unescape(safe) == one_line(hostile, 200)
    assert html_text("<" * 500, 300) == "&lt;" * 300
