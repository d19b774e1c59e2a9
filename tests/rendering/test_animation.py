"""Frames made on several processes: equal to those of one, in order, and a clear error when a process is killed."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from failing_avatar import FailingAvatar

from snarfcli.errors import UserError
from snarfcli.rendering.animation import Animation
from snarfcli.rendering.panels import Screen
from snarfcli.rendering.pictures import frame_processes, make_pictures
from snarfcli.rendering.stage import body_points, set_stage
from snarfcli.rendering.views import parse_views

BENDS = [0.0, 0.3, 0.5, 0.7, 0.9, 1.2]


def animation(folder: Path) -> Animation:
    avatar = FailingAvatar()
    poses, translation = np.zeros((len(BENDS), 2, 3)), np.zeros((len(BENDS), 3))
    poses[:, 1, 2] = BENDS
    stage = set_stage(body_points(avatar, poses, translation), poses, parse_views(["front", "top"]))
    return Animation(
        avatar, "bend", poses, translation, list(range(10, 16)), surface="field", resolution=24, folder=folder, suffix="ply",
        screen=Screen(stage, (48, 40), {"avatar": "avatar"}),
    )  # fmt: skip


def test_several_processes_make_the_same_frames_and_a_lost_one_is_reported(tmp_path):
    alone, together = animation(tmp_path / "alone"), animation(tmp_path / "together")
    pictures = make_pictures(alone)
    wanted = [next(pictures) for _ in range(5)]
    made = make_pictures(together, processes=2)
    for picture in wanted:
        np.testing.assert_array_equal(next(made), picture)
    assert [(frame.frame, frame.file, frame.vertices) for frame in together.frames] == [
        (frame.frame, frame.file, frame.vertices) for frame in alone.frames
    ]
    assert [frame.problem is not None for frame in together.frames] == [False, False, True, False, False]
    with pytest.raises(UserError, match=r"ended early \(exit code 9\); .*fewer workers, for example processes=1") as caught:
        next(made)
    assert "\n" not in str(caught.value)
    assert not multiprocessing.active_children()
    names = [f"frame_{index:06d}.ply" for index in (0, 1, 3, 4)]
    assert sorted(path.name for path in (tmp_path / "together").iterdir()) == names
    for name in names:
        assert (tmp_path / "together" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


def test_surfaces_made_here_are_drawn_elsewhere(tmp_path):
    alone, together = animation(tmp_path / "alone"), animation(tmp_path / "together")
    pictures, made = make_pictures(alone), make_pictures(together, processes=2, extracts_here=True)
    for _ in range(3):  # the third has no surface
        np.testing.assert_array_equal(next(made), next(pictures))
    assert [frame.vertices for frame in together.frames] == [frame.vertices for frame in alone.frames]
    assert all(frame.rendering_s > 0 for frame in together.frames)
    made.close()
    assert not multiprocessing.active_children()


def test_a_picture_that_fails_in_a_process_is_reported(tmp_path):
    broken = animation(tmp_path)
    broken.screen.settled = None  # only drawing looks at it
    with pytest.raises(TypeError, match="NoneType"):
        list(make_pictures(broken, processes=2, extracts_here=True))
    assert not multiprocessing.active_children()


def test_number_of_processes_for_frames():
    assert frame_processes(4, 100, 128) == 4
    assert frame_processes(4, 3, 128) == 3
    assert frame_processes(None, 2, 128) == 1  # not worth a second process
    assert frame_processes(None, 1000, 100_000) == 1  # no memory for it
    assert frame_processes(4, 100, 128, extract=False) == 4
    assert frame_processes(4, 100, 128, extract=False, draw=False) == 1
