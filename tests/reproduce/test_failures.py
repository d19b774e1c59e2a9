"""Which failures of a command may pass: told by its exit code and by its own last line."""

from __future__ import annotations

import errno
import os
import signal
import time

import pytest

from snarfcli.cli.messages import user_message
from snarfcli.errors import LOST_DRIVE, UserError, raise_system_error
from snarfcli.parallel import Worker
from snarfcli.reproduce.failures import AGAIN, ALONE, reason_of, retry_of, retry_of_error


def from_reader(error: BaseException) -> BaseException:
    """Return what the readers of files make of an error."""
    try:
        raise_system_error(error, "x.npz")
    except (OSError, MemoryError) as raised:
        return raised
    return error


NOT_ENOUGH_MEMORY = (
    MemoryError(),
    from_reader(MemoryError()),
    MemoryError("evaluating the shape ran out of memory; evaluate fewer points at once"),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:117] . DefaultCPUAllocator: can't allocate memory: you tried 9 bytes."),
    RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    UserError("device: wanted cuda, got none, since cuda:0 cannot be used (CUDA error: out of memory); give device=cpu"),
)
STAYS = (
    OSError(errno.ENOSPC, "No space left on device", "outputs/x"),
    OSError(errno.EDQUOT, "Disk quota exceeded", "outputs/x"),
    PermissionError(errno.EACCES, "Permission denied", "outputs/x"),
    FileNotFoundError(errno.ENOENT, "No such file or directory", "outputs/x"),
    UserError("there is no training=quik; did you mean 'quick'?"),
    UserError("training diverged at step 5: the loss is nan"),
)


@pytest.mark.parametrize("error", NOT_ENOUGH_MEMORY, ids=repr)
def test_too_little_memory_may_be_enough_alone(error):
    assert retry_of(2, user_message(error) or "") == ALONE
    assert isinstance(error, UserError) or retry_of_error(error) == ALONE


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_a_worker_that_the_system_has_killed_may_have_enough_memory_alone():
    worker = Worker(time.sleep, (600,))
    worker._process.kill()
    with pytest.raises(UserError) as caught:
        worker.receive()
    worker.end()
    assert retry_of(2, str(caught.value)) == ALONE


@pytest.mark.parametrize("code", LOST_DRIVE, ids=errno.errorcode.get)
def test_a_network_drive_may_be_there_again(code):
    error = OSError(code, os.strerror(code), "data/x.npz")
    assert retry_of(2, user_message(error) or "") == AGAIN
    assert retry_of_error(error) == AGAIN


@pytest.mark.parametrize("error", STAYS, ids=repr)
def test_what_somebody_must_mend_stays(error):
    assert retry_of(2, user_message(error) or "") == ""
    assert retry_of_error(error) == ""


@pytest.mark.skipif(os.name != "posix", reason="signals as on Unix")
def test_signals_that_nobody_sends_on_purpose_may_pass():
    names = {"SIGKILL": ALONE, "SIGBUS": AGAIN, "SIGSEGV": AGAIN, "SIGABRT": AGAIN, "SIGTERM": "", "SIGINT": "", "SIGILL": ""}
    for name, wanted in names.items():
        assert retry_of(-getattr(signal, name), "") == wanted
    for code in (1, 129, 130, 143, -99):  # a fault of the program, or a request to end
        assert retry_of(code, "interrupted; out of memory") == ""


def test_the_reason_is_the_last_line_of_the_last_command(tmp_path):
    log = tmp_path / "log"
    log.write_text("$ snarf train\nsnarf train: old\n")
    begin = log.stat().st_size
    assert reason_of(log, begin, 3) == "exit code 3"
    log.write_text(log.read_text() + "$ snarf eval\n")
    assert reason_of(log, begin, 3) == "exit code 3"
    log.write_text(log.read_text() + "busy\nsnarf eval: no avatar: train one\n\n")
    assert reason_of(log, begin, 2) == "no avatar: train one"
    log.write_text(log.read_text() + "ValueError: a fault\n")
    assert reason_of(log, begin, 1) == "ValueError: a fault"
    assert reason_of(log, begin, -99) == "ended by signal 99"
    log.write_text(log.read_text() + "snarf of a program without colons\n")
    assert reason_of(log, begin, 1) == "snarf of a program without colons"
    log.write_text(log.read_text() + f"ValueError: \x1b[2J{'long' * 100_000}\n")
    assert reason_of(log, begin, 1).startswith("ValueError: [2Jlong"), "no control characters"
    assert len(reason_of(log, begin, 1)) == 2000, "a status with longer texts could not be read again"
