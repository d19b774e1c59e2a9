"""No text that is printed can change a terminal."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
import warnings

import pytest

from snarfcli import progress
from snarfcli.cli import main as cli
from snarfcli.cli import terminal
from snarfcli.cli.messages import user_message
from snarfcli.errors import UserError

HOSTILE = "a\x1b]0;title\x07\x1b[2J\rb\u202ec"
SHOWN = r"a\x1b]0;title\x07\x1b[2J\rb\u202ec"


def test_log_lines():
    record = logging.LogRecord("snarfcli.x", logging.INFO, __file__, 1, "motion: %s\n\tnext", (HOSTILE,), None)
    assert terminal.TerminalFormatter("%(message)s").format(record) == f"motion: {SHOWN}\n\tnext"


def test_log_lines_have_bounded_length():
    record = logging.LogRecord("snarfcli.x", logging.INFO, __file__, 1, "motion: %s", ("x" * 10**6,), None)
    assert len(terminal.TerminalFormatter("%(message)s").format(record)) == 20_003


def test_messages(capsys):
    assert cli.main([f"train{HOSTILE}"]) == 2
    assert cli.main(["train", f"run=x/{HOSTILE}"]) == 2
    assert cli.main(["train", f"--{HOSTILE}"]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 3
    assert all(letter.isprintable() or letter == "\n" for letter in error)


def test_warnings_traces_and_logs_of_a_process():
    code = (
        "import logging, warnings\nfrom snarfcli.cli.terminal import set_up_output\nset_up_output()\n"
        f"text = {HOSTILE!r}\nwarnings.warn(text)\nlogging.getLogger('snarfcli.x').info(text)\nraise RuntimeError(text)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stdout == SHOWN + "\n"
    assert f"UserWarning: {SHOWN}" in done.stderr
    assert f"RuntimeError: {SHOWN}" in done.stderr
    assert all(letter.isprintable() or letter == "\n" for letter in done.stdout + done.stderr)


def test_bars(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    with warnings.catch_warnings():
        assert list(progress.progress([1, 2], desc=f"animate {HOSTILE}" + "x" * 1000)) == [1, 2]
    text = shown.getvalue()
    assert "animate a ]0;title" in text
    assert "\x1b]0" not in text
    assert "\x1b[2J" not in text
    assert "x" * 100 not in text


def test_a_message_has_bounded_length():
    message = user_message(UserError("no joint " + "\x1b[2J" * 10_000))
    assert message is not None
    assert len(message) == 2000
    assert message.endswith("...")
    assert message.isprintable()
    assert user_message(OSError(28, "full", "x" * 5000)).endswith("...")  # type: ignore[union-attr]


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_characters_that_the_terminal_lacks_are_escaped(tmp_path, encoding):
    """As with the code pages of Windows, or without a locale."""
    code = (
        "import logging; from snarfcli.cli import main as cli; from snarfcli.commands import doctor; "
        "doctor.run = lambda config: doctor.log.info('reading %s', config.data_root); "
        "raise SystemExit(cli.main(['doctor', 'data_root=größe_漢']) or cli.main(['doctor', 'größe_漢=1']))"
    )
    environment = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True)
    name = b"gr\xf6\xdfe_\\u6f22" if encoding == "cp1252" else b"gr\\xf6\\xdfe_\\u6f22"
    assert done.stdout.splitlines() == [b"reading " + name]
    assert done.stderr.startswith(b"snarf doctor: ")
    assert b"Traceback" not in done.stderr
    assert name in done.stderr
    assert done.returncode == 2
