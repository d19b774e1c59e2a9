"""Lines about several parts of a task: replaced on a terminal, logged now and then otherwise."""

from __future__ import annotations

import io
import logging
import os
import re
import sys

import pytest

from snarfcli import progress as progress_module
from snarfcli.progress import ProgressLines, progress

HOSTILE = "a\x1b]0;title\x07\x1b[2Jb"


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: now[0])
    return now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def seen(text: str, height: int = 5) -> list[str]:
    """Return what a terminal shows after a text with the control sequences of tqdm."""
    rows, row, column = [""] * height, 0, 0
    for part in re.findall(r"\x1b\[A|\n|\r|[^\x1b\n\r]+", text):
        if part == "\x1b[A":
            row = max(0, row - 1)
        elif part == "\n":
            row, column = row + 1, 0
        elif part == "\r":
            column = 0
        else:
            rows[row] = rows[row][:column].ljust(column) + part + rows[row][column + len(part) :]
            column += len(part)
    return [line.rstrip() for line in rows]


@pytest.mark.parametrize(("seconds", "speed"), [(0.5, "2.0 frames/s"), (4.0, "4.0 s each")])
def test_in_a_log_slow_items_have_seconds_instead_of_a_speed_of_zero(clock, caplog, seconds, speed):
    caplog.set_level(logging.INFO, "snarfcli")
    for _ in progress(range(45), desc="fit", unit="frames"):
        clock[0] += seconds
    assert caplog.messages[0].endswith(f" of 45 frames, {speed}")


def test_in_a_log_lines_are_one_record_per_minute(clock, caplog):
    caplog.set_level(logging.INFO, "snarfcli")
    lines = ProgressLines()
    assert not lines.is_due(), "not at once"
    clock[0] += 61
    assert lines.is_due()
    lines.show(["two are running", "  one", "  another"])
    assert not lines.is_due()
    lines.hide()
    assert not lines.is_due()
    lines.close()
    assert caplog.messages == ["two are running\n  one\n  another"]


def test_on_a_terminal_lines_are_replaced(clock, monkeypatch):
    pytest.importorskip("tqdm")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(progress_module.shutil, "get_terminal_size", lambda: os.terminal_size((20, 10)))
    lines = ProgressLines()
    assert lines.is_due()
    lines.show(["2 of 9", f" {HOSTILE}", "x" * 100])
    assert seen(terminal.getvalue())[:3] == ["2 of 9", " a\\x1b]0;title\\x07\\", "x" * 19]
    assert not lines.is_due()
    clock[0] += 1.1
    assert lines.is_due()
    lines.show(["3 of 9", " b"])
    assert seen(terminal.getvalue()) == ["3 of 9", " b", "", "", ""], "a line that is gone leaves nothing"
    lines.hide()
    assert seen(terminal.getvalue()) == [""] * 5
    assert lines.is_due(), "so that they come back"
    lines.show(["4 of 9"])
    assert seen(terminal.getvalue())[0] == "4 of 9"
    lines.close()
    assert seen(terminal.getvalue()) == [""] * 5
    assert "\x1b]" not in terminal.getvalue()
