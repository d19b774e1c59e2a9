"""What clients send, without a server."""

from __future__ import annotations

import logging
import math
import random
import threading

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")

import msgspec
from wrong_messages import CAMERA, CLICK, DRAG, wrong_bytes, wrong_messages

from snarfcli.viewer.gate import Gate, is_number, is_vector


@pytest.fixture
def gate() -> Gate:
    gate = Gate()
    gate.add_handle("/handle")
    gate.add_clickable("/skeleton/joints", 2)
    return gate


def admits(gate: Gate, message: object) -> bool:
    return gate.admits(msgspec.msgpack.encode(message))


def test_numbers_and_vectors():
    assert is_number(1)
    assert is_number(0.5, 0, 1)
    for wrong in (True, "1", None, math.nan, math.inf, -math.inf, 10**30, [1], 1.5):
        assert not is_number(wrong, -1, 1)
    assert is_vector([1, 2.5, 3], 3)
    for wrong in ([1, 2], [1, 2, 3, 4], [1, 2, math.nan], (1, 2, 3), "abc", {0: 1, 1: 2, 2: 3}, None, [1, 2, [3]]):
        assert not is_vector(wrong, 3)


def test_what_the_page_sends_is_admitted(gate):
    for message in (CAMERA, CLICK, DRAG, {"type": "TransformControlsDragEndMessage", "name": "/handle", "owner": ""}):
        assert admits(gate, message)
    assert admits(gate, {**CLICK, "modifier": "cmd/ctrl+shift"})


def test_what_the_page_never_sends_is_not(gate):
    wrong = list(wrong_messages(["an-input"], random.Random(0)))
    assert len(wrong) > 100
    for message in wrong:
        assert not admits(gate, message), message
    for data in wrong_bytes(random.Random(0)):
        assert not gate.admits(data)
    assert not gate.admits("text")  # type: ignore[arg-type]
    assert not admits(gate, {**CLICK, "instance_index": 2})
    assert not admits(Gate(), DRAG)  # before there is a handle
    assert not admits(Gate(), CLICK)


def test_a_refused_value_is_followed_by_the_true_one(gate):
    shown = []
    gate.add_input("speed", lambda value: value == 1, lambda: shown.append("true one"))
    assert admits(gate, {"type": "GuiUpdateMessage", "uuid": "speed", "updates": {"value": 1}})
    assert not shown
    assert not admits(gate, {"type": "GuiUpdateMessage", "uuid": "speed", "updates": {"value": 3000}})
    assert shown == ["true one"]
    for updates in ({}, {"value": 1, "label": "x"}, {"removed": True}, [1], None):
        assert not admits(gate, {"type": "GuiUpdateMessage", "uuid": "speed", "updates": updates})


def test_one_refusal_is_reported_in_one_line(gate, caplog):
    for kind in ("a\n\x1b[2J" + "x" * 1000, "b"):
        assert not admits(gate, {"type": kind})
    (record,) = caplog.records
    assert record.message.isprintable()
    assert len(record.message) < 200


def test_reactions_are_counted_and_their_errors_are_one_line(gate, caplog):
    begun, go_on = threading.Semaphore(0), threading.Event()

    def wait(event: str) -> None:
        begun.release()
        assert go_on.wait(300)

    threads = [threading.Thread(target=gate.reaction(wait), args=("",)) for _ in range(16)]
    for thread in threads:
        assert not gate.is_busy
        thread.start()
        assert begun.acquire(timeout=300)
    assert gate.is_busy
    go_on.set()
    for thread in threads:
        thread.join()
    assert not gate.is_busy
    with caplog.at_level(logging.ERROR):
        gate.reaction(lambda event: 1 / 0)("")
    assert "ZeroDivisionError: division by zero" in caplog.text
    assert not gate.is_busy
