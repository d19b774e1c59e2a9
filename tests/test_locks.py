"""Locks between processes, and what happens on file systems without them."""

from __future__ import annotations

import errno
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from snarfcli.locks import hold_slot, locked, try_lock


class Stop(Exception):
    """Ends the waiting for a lock."""


def stop() -> None:
    raise Stop


def test_the_second_waits_until_the_first_is_done(tmp_path: Path) -> None:
    events: list[str] = []

    def second() -> None:
        with locked(tmp_path / "folder" / "lock"):
            events.append("second")

    with locked(tmp_path / "folder" / "lock"):
        thread = threading.Thread(target=second)
        thread.start()
        with pytest.raises(Stop), locked(tmp_path / "folder" / "lock", check=stop):
            pass
        events.append("first")
    thread.join()
    assert events == ["first", "second"]


def test_two_slots_take_two_and_no_third(tmp_path: Path) -> None:
    with hold_slot(tmp_path, 2) as one, hold_slot(tmp_path, 2) as two, pytest.raises(Stop), hold_slot(tmp_path, 2, stop):
        pass
    assert (one, two) == (0, 1)


def test_the_lowest_free_slot_is_taken_and_none_is_waited_for(tmp_path: Path) -> None:
    with hold_slot(tmp_path / "slots") as zero:
        with hold_slot(tmp_path / "slots") as one, hold_slot(tmp_path / "slots") as two:
            assert (zero, one, two) == (0, 1, 2)
        with hold_slot(tmp_path / "slots") as again:
            assert again == 1
    assert not list((tmp_path / "slots").iterdir())


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    code = (
        "import sys, time; from pathlib import Path; from snarfcli.locks import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(1000)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == "held\n"
        assert try_lock(path) is None
        process.send_signal(signal.SIGKILL)
        process.wait()
    release = try_lock(path)
    assert release is not None
    release()


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK, errno.EINVAL])
def test_a_file_system_without_locks_is_named_once(tmp_path: Path, monkeypatch, caplog, code: int) -> None:
    fcntl = pytest.importorskip("fcntl")

    def fail(*arguments: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", fail)
    with caplog.at_level(logging.WARNING), locked(tmp_path / "lock"), locked(tmp_path / "lock"):
        pass
    [record] = caplog.records
    assert f"the file system of {tmp_path} cannot lock files ({os.strerror(code)})" in record.getMessage()


def test_other_failures_are_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        try_lock(tmp_path / "file" / "lock")
