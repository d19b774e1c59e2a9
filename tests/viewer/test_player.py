from __future__ import annotations

import pytest

from snarfcli.viewer.player import Player


@pytest.fixture
def player() -> Player:
    player = Player()
    player.load(5, 10.0)
    return player


def test_frames_follow_the_clock(player):
    assert [player.frame(now) for now in (0.0, 3.0)] == [0, 0]
    player.play(100.0)
    assert [player.frame(100.0 + late) for late in (0.0, 0.09, 0.1, 0.25, 0.45, 0.5, 0.62)] == [0, 0, 1, 2, 4, 0, 1]
    assert player.seconds_to_next(100.02) == pytest.approx(0.08)


def test_the_end_stops_what_does_not_loop(player):
    player.change_looping(False, 0.0)
    player.play(0.0)
    assert player.frame(0.39) == 3
    assert player.is_playing
    assert player.frame(7.0) == 4
    assert not player.is_playing
    assert player.seconds_to_next(7.0) is None
    player.play(8.0)  # from the start again
    assert player.frame(8.0) == 0
    assert player.frame(8.1) == 1


def test_a_pause_keeps_the_frame(player):
    player.play(0.0)
    player.pause(0.33)
    assert player.frame(99.0) == 3
    player.play(100.0)
    assert player.frame(100.0) == 3
    assert player.frame(100.1) == 4


def test_seeking_and_speed(player):
    player.seek(3, 0.0)
    assert player.frame(0.0) == 3
    player.seek(99, 0.0)
    assert player.frame(0.0) == 4
    player.seek(0, 0.0)
    player.play(0.0)
    player.change_speed(0.5, 0.2)  # two frames at the full pace, then half of it
    assert player.frame(0.39) == 2
    assert player.frame(0.41) == 3
    assert player.seconds_to_next(0.2) == pytest.approx(0.2)
    player.change_looping(False, 0.45)
    assert player.frame(0.45) == 3


def test_nothing_to_play():
    player = Player()
    player.play(0.0)
    assert not player.is_playing
    assert player.frame(5.0) == 0
    assert player.seconds_to_next(5.0) is None
    player.load(1, 30.0)  # a pose
    player.play(0.0)
    assert not player.is_playing
    assert player.frame(9.0) == 0
    assert player.seconds_to_next(9.0) is None
