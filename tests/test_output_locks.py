"""One output folder has one writer at a time, with its child processes."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from snarfcli.errors import UserError
from snarfcli.locks import try_lock
from snarfcli.output_locks import hold_all_inside, hold_output, holder_is_gone, outputs_in_use


def test_the_second_writer_of_an_output_is_told_who_holds_it(tmp_path: Path) -> None:
    (tmp_path / "other").symlink_to(tmp_path)
    with hold_output(tmp_path / "run", "snarf train"):
        wanted = (
            rf"run is in use by snarf train \(process {os.getpid()}, since 20\d\d-.*\); wait until it ends, or give wait=true"
        )
        for same in (tmp_path / "run", tmp_path / "x" / ".." / "run", tmp_path / "other" / "run"):
            with pytest.raises(UserError, match=wanted), hold_output(same, "snarf train"):
                pass
        with hold_output(tmp_path / "run" / "eval_id", "snarf eval"):
            pass
    with hold_output(tmp_path / "run", "snarf train"):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"other"}, "nothing is left behind"


def test_the_second_writer_waits_if_it_is_told_to(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    events: list[str] = []

    def second() -> None:
        with hold_output(tmp_path / "run", "snarf train", wait=True):
            events.append("second")

    with caplog.at_level(logging.INFO), hold_output(tmp_path / "run", "snarf train"):
        thread = threading.Thread(target=second)
        thread.start()
        while not caplog.records:
            time.sleep(0.05)
        events.append("first")
    thread.join()
    assert events == ["first", "second"]
    assert "waiting: " in caplog.text


def test_a_folder_beside_which_nothing_can_be_written_has_its_lock_inside(tmp_path: Path, monkeypatch) -> None:
    disk, other = tmp_path / "disk", tmp_path / "other"
    disk.mkdir()
    other.mkdir()
    is_mount, access = os.path.ismount, os.access
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == disk or is_mount(path))
    for output in (disk, other):
        with hold_output(output, "snarf animate"):
            assert len(list(output.iterdir())) == (2 if output == disk else 0)
            with pytest.raises(UserError, match=f"{output} is in use by snarf animate"), hold_output(output, "snarf animate"):
                pass
            [line] = outputs_in_use(tmp_path)
            assert line.startswith(f"{output} by snarf animate (process {os.getpid()}")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path and access(path, mode))
    with hold_output(other, "snarf animate"):
        assert len(list(other.iterdir())) == 2
    assert not [*disk.iterdir(), *other.iterdir()], "nothing is left behind"


def test_locks_of_other_programs_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / ".theirs.lock").touch()
    (tmp_path / ".killed.holder.json").write_text("{}")
    assert not outputs_in_use(tmp_path)
    assert (tmp_path / ".theirs.lock").exists()


@pytest.mark.parametrize(
    "said", ["", "{", "[" * 5000, '{"pid": 1}', '{"command": "\\u001b[2J", "host": "h", "since": "", "pid": 3}']
)
def test_what_a_lock_says_about_its_holder_is_not_trusted(tmp_path: Path, said: str) -> None:
    release = try_lock(tmp_path / ".run.lock")
    assert release is not None
    (tmp_path / ".run.holder.json").write_text(said)
    with pytest.raises(UserError, match="is in use by") as refused, hold_output(tmp_path / "run", "snarf train"):
        pass
    assert str(refused.value).isprintable()
    release()


_HOLDER_WITH_CHILD = """
import sys, time
from pathlib import Path
from snarfcli.interrupts import interrupts_held_back
from snarfcli.output_locks import hold_output
from snarfcli.parallel import Worker
from test_output_locks import slow
with hold_output(sys.argv[1], "snarf train"), interrupts_held_back():
    worker = Worker(slow, (sys.argv[2],))
    print(worker.receive(), flush=True)
    time.sleep(1000)
"""


def slow(place: str) -> Iterator[int]:
    """Write a file that says that the work goes on, until the process ends."""
    yield 1
    for number in range(10**6):
        Path(place).write_text(str(number))


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_lock_lasts_until_the_children_of_a_killed_holder_have_ended(tmp_path: Path) -> None:
    code, output, written = _HOLDER_WITH_CHILD, tmp_path / "run", tmp_path / "written"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(output), str(written)],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )  # fmt: skip
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == "(True, 1)\n"
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert holder_is_gone(output)
        with hold_output(output, "snarf train"):  # although it was said to be in use
            before = written.read_text() if written.exists() else None
            time.sleep(0.3)
            assert (written.read_text() if written.exists() else None) == before


def test_a_folder_with_an_output_in_use_is_not_deleted(tmp_path: Path) -> None:
    refused = pytest.raises(UserError, match=r"eval_id is in use by snarf eval \(")
    with hold_output(tmp_path / "run" / "eval_id", "snarf eval"), refused, hold_all_inside(tmp_path / "run", "snarf train"):
        pass
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".eval_id.lock").touch()
    with hold_all_inside(tmp_path / "run", "snarf train"):
        assert try_lock(tmp_path / "run" / ".eval_id.lock") is None
