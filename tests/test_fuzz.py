from __future__ import annotations

import contextlib
import os
import random

import fuzzing
import pytest
from fuzz_damage import DAMAGES
from fuzz_targets import TARGETS
from fuzzing import Target, broken_file, check_target

from snarfcli.errors import UserError

_COUNT = 300  # files per fast reader; `python tools/fuzz_readers.py` reads 20,000


@pytest.mark.parametrize("make", TARGETS, ids=lambda make: make.__name__)
def test_broken_files_are_read_or_rejected_in_one_line(make, tmp_path):
    target = make()
    assert target.name == make.__name__
    check_target(target, _COUNT // target.cost, 0, tmp_path)


def _toy(read) -> Target:
    return Target("toy", ".toy", lambda: [b"one 1\ntwo 2\n", b"\0\1\2\3 three 3"], read)


def _rejecting(message):
    """Return a reader that accepts the seed files and rejects all others."""
    seeds = _toy(None).seeds()

    def read(path):
        if path.read_bytes() not in seeds:
            raise UserError(message(path))

    return read


def test_good_reader_passes(tmp_path):
    check_target(_toy(_rejecting(lambda path: f"file {path} is no toy; give another")), 200, 0, tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


def test_files_are_repeatable_and_differ():
    files = [broken_file(_toy(None), 0, index) for index in range(200)]
    assert files == [broken_file(_toy(None), 0, index) for index in range(200)]
    assert files != [broken_file(_toy(None), 1, index) for index in range(200)]
    assert len(set(files)) > 150


def test_every_kind_of_damage_works_on_any_bytes():
    for number, damage in enumerate(DAMAGES):
        for content in (b"", b"x", b"a 1.5\nb -2\n", bytes(range(256))):
            for repeat in range(50):
                assert isinstance(damage(random.Random(f"{number}{repeat}"), content, b""), bytes)


def test_format_aware_damage_is_used(tmp_path):
    seen = []
    target = Target("toy", ".toy", lambda: [b"one"], lambda path: seen.append(path.read_bytes()), lambda rng, content: b"extra")
    check_target(target, 100, 0, tmp_path)
    assert b"extra" in seen


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (lambda path: "file is no toy", "does not name the file"),
        (lambda path: f"{path} is\nno toy", "not one printable line"),
        (lambda path: f"{path} holds \u2028", "not one printable line"),
        (lambda path: f"{path} holds \x1b[2J", "not one printable line"),
        (lambda path: f"{path} holds {'x' * 2000}", "characters"),
    ],
)
def test_bad_messages_are_found(message, complaint, tmp_path):
    with pytest.raises(AssertionError, match=complaint):
        check_target(_toy(_rejecting(message)), 50, 0, tmp_path)


def test_other_errors_are_found_and_the_bytes_kept(tmp_path):
    def read(path):
        if path.read_bytes() not in _toy(None).seeds():
            raise KeyError("header")

    with pytest.raises(AssertionError, match="KeyError: 'header'"):
        check_target(_toy(read), 50, 3, tmp_path)
    (kept,) = tmp_path.iterdir()
    index = int(kept.stem.split("-")[-1])
    assert kept.read_bytes() == broken_file(_toy(read), 3, index)


def test_rejected_seed_is_found(tmp_path):
    def read(path):
        raise UserError(f"{path} is no toy")

    with pytest.raises(AssertionError, match="seed 0 must be a good file"):
        check_target(_toy(read), 5, 0, tmp_path)


def test_endless_reader_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzzing, "MAX_CPU_SECONDS", 0.2)

    def read(path):
        while path.read_bytes() not in _toy(None).seeds():
            with contextlib.suppress(Exception):  # a reader that swallows every error does not swallow this one
                sum(range(1000))

    with pytest.raises(AssertionError, match=r"took over 0.2 s"):
        check_target(_toy(read), 50, 0, tmp_path)


@pytest.mark.skipif(fuzzing.peak_memory() == 0, reason="this system does not report the peak memory")
def test_greedy_reader_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzzing, "MAX_GROWTH", 2**26)
    monkeypatch.setattr(fuzzing, "MAX_CPU_SECONDS", 600)  # of no matter here, and large memory takes its time

    def read(path):
        if path.read_bytes() not in _toy(None).seeds():
            # More than the peak of this process so far: only a new peak can be measured.
            bytearray(b"\1") * (2**27 + fuzzing.peak_memory())

    with pytest.raises(AssertionError, match="of memory"):
        check_target(_toy(read), 50, 0, tmp_path)


@pytest.mark.parametrize("act", [lambda path: os.system("true"), lambda path: path.with_name("x").write_text(""), os.unlink])
def test_forbidden_acts_are_found(act, tmp_path):
    with pytest.raises(AssertionError, match="_Forbidden"):
        check_target(_toy(lambda path: path.read_bytes() in _toy(None).seeds() or act(path)), 50, 0, tmp_path)
