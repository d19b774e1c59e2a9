"""How far the fit of a sequence is."""

from __future__ import annotations

from snarfcli.registration.fit_progress import FrameProgress


def test_frames_are_told_while_the_work_goes_on():
    told: list[int] = []
    progress = FrameProgress(10, 40, 10, told.append)
    progress.add(20)
    assert told == [0, 1, 2, 3, 4]
    progress.add(100)  # more than was expected, but not the last stage
    assert told == list(range(7))
    progress.start_last()
    for _ in range(10):
        progress.add(1)
    progress.finish()
    assert told == list(range(10))


def test_less_work_than_expected_tells_all_frames():
    told: list[int] = []
    progress = FrameProgress(10, 40, 10, told.append)
    progress.start_last()
    assert told == list(range(7))
    progress.finish()
    progress.finish()
    assert told == list(range(10))
    FrameProgress(3, 1, 1, None).finish()
