"""Files of hostile authors end in one line, run nothing, show nothing of the environment and take little memory."""

from __future__ import annotations

import logging

import pytest
from fuzz_own_targets import use_avatar
from fuzzing import MAX_MESSAGE, peak_memory
from hostile_avatars import HARMLESS, SECRET_NAME, hostile_avatars, hostile_records

from snarfcli.cli.main import main
from snarfcli.commands.animation_folder import RECORD, check_record
from snarfcli.errors import UserError

SECRET = "kept-out-of-every-output"
ENTRIES = hostile_avatars()
# One of each kind, through the command: composing its configuration takes a third of a second.
COMMANDED = (
    "model.name interpolated", "shape.width nested", "shape.width huge", "facts subject escapes", "a weight NaN",
    "calls os.system", "archive bomb", "archive cut in half", "facts that double 40 times", "joints without end", "pipe",
    "folder", "no state",
    "a weight with a wild name", "grid of 20 km", "format of another program",
)  # fmt: skip


@pytest.fixture(autouse=True)
def secret(monkeypatch, caplog):
    monkeypatch.setenv(SECRET_NAME, SECRET)
    caplog.set_level(logging.INFO)


def test_there_are_many_of_them():
    assert len(ENTRIES) >= 150
    assert set(HARMLESS) | set(COMMANDED) <= ENTRIES.keys()


@pytest.mark.parametrize("name", ENTRIES)
def test_a_hostile_avatar_is_refused_in_one_line(name, tmp_path, caplog, capfd):
    ENTRIES[name](tmp_path)
    before, message = peak_memory(), ""
    try:
        use_avatar(tmp_path / "avatar.pt")
    except UserError as error:
        message = str(error)
    assert peak_memory() - before < 2**30
    assert bool(message) == (name not in HARMLESS)
    if message:
        assert "avatar.pt" in message
        assert message.isprintable()
        assert len(message) - len(str(tmp_path)) < MAX_MESSAGE
    out, err = capfd.readouterr()
    assert SECRET not in message + caplog.text + out + err


@pytest.mark.parametrize("name", COMMANDED)
def test_a_command_with_a_hostile_avatar_prints_one_line(name, tmp_path, capfd):
    ENTRIES[name](tmp_path)
    code = main(["export", f"ckpt={tmp_path}", f"output={tmp_path / 'x.glb'}", "resolution=16", "triangles=100", "device=cpu",
                 "max_frames=2"])  # fmt: skip
    out, err = capfd.readouterr()
    assert SECRET not in out + err
    assert "Traceback" not in out + err
    assert all(letter.isprintable() or letter == "\n" for letter in out + err)
    assert code == 2
    assert err.startswith("snarf export: ")
    assert err.count("\n") == 1
    assert not (tmp_path / "x.glb").exists()


@pytest.mark.parametrize("name", hostile_records())
def test_a_hostile_record_of_an_animation_is_refused_in_one_line(name, tmp_path):
    (tmp_path / RECORD).write_bytes(hostile_records()[name])
    with pytest.raises(UserError) as caught:
        check_record(tmp_path, {"surface": "field"})
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) - 2 * len(str(tmp_path)) < MAX_MESSAGE
    assert SECRET not in message
