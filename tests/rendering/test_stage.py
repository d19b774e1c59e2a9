from __future__ import annotations

import math

import numpy as np
import pytest

from snarfcli.errors import UserError
from snarfcli.rendering.panels import Screen, picture_size
from snarfcli.rendering.stage import set_stage
from snarfcli.rendering.views import parse_turntable, parse_views

FRAMES = 60


def walk(stride: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Return points [T, K, 3] of a box that walks along z and sways, and poses that face the way it goes."""
    rng = np.random.default_rng(0)
    body = rng.uniform((-0.4, 0, -0.2), (0.4, 1.8, 0.2), (80, 3))
    way = np.zeros((FRAMES, 3))
    way[:, 2] = stride * np.arange(FRAMES)
    way[:, 0] = 0.05 * np.sin(2 * math.pi * np.arange(FRAMES) / 15)
    return body + way[:, None] + (3, 0.5, 0), np.zeros((FRAMES, 2, 3))


def places(stage, view, frame, points, size=(100, 100)) -> np.ndarray:
    return stage.camera(view, frame).project(points, *size)[:, :2] / size


def test_a_still_camera_sees_the_whole_motion_from_every_side_at_one_scale():
    points, poses = walk()
    stage = set_stage(points, poses, parse_views(["front", "left", "back", "top", "-45"], 20, 9))
    assert stage.is_still
    assert stage.floor.spacing is None
    assert stage.floor.height == pytest.approx(points[..., 1].min())
    distances = []
    for view in range(5):
        assert stage.camera(view, 0) == stage.camera(view, FRAMES - 1)
        seen = places(stage, view, 0, points.reshape(-1, 3))
        assert seen.min() > 0.05
        assert seen.max() < 0.95
        camera = stage.camera(view, 0)
        distances.append(np.linalg.norm(np.subtract(camera.position, camera.target)))
    np.testing.assert_allclose(distances, distances[0])
    ahead = np.subtract(stage.camera(0, 0).position, stage.camera(0, 0).target)
    assert math.degrees(math.atan2(ahead[0], ahead[2])) == pytest.approx(20)
    heights = [stage.camera(view, 0).target[1] for view in (0, 1, 2, 4)]
    np.testing.assert_allclose(heights, heights[0])


def test_a_camera_that_follows_keeps_the_body_in_the_middle_and_does_not_sway():
    points, poses = walk()
    stage = set_stage(points, poses, parse_views(["left"]), camera="follow")
    still = set_stage(points, poses, parse_views(["left"]))
    assert stage.floor.spacing == pytest.approx(0.5)  # lines show that it walks
    for frame in (0, 30, FRAMES - 1):
        seen = places(stage, 0, frame, points[frame])
        assert seen.min() > 0.05
        assert seen.max() < 0.95
        assert abs(seen[:, 0].mean() - 0.5) < 0.06
    where = np.array([stage.camera(0, frame).position for frame in range(FRAMES)])
    np.testing.assert_allclose(np.diff(where[:, 2]), 0.05, atol=0.01)  # at the pace of the walk, to its ends
    assert np.ptp(where[:, 0]) < 0.3 * 0.1
    assert np.ptp(where[:, 1]) == 0
    span = [np.linalg.norm(np.subtract(one.camera(0, 0).position, one.camera(0, 0).target)) for one in (stage, still)]
    assert span[0] < 0.8 * span[1]  # so the body is larger


def test_a_turntable_goes_round_with_everything_in_the_picture():
    points, poses = walk(0.0)
    stage = set_stage(points, poses, parse_views(["front"]), turn_rad_s=math.radians(90), frame_rate=30.0)
    offsets = [np.subtract(stage.camera(0, f).position, stage.camera(0, f).target) for f in (0, 30)]
    np.testing.assert_allclose([offsets[1][0], offsets[1][2]], [offsets[0][2], -offsets[0][0]], atol=1e-9)
    for frame in range(0, FRAMES, 7):
        seen = places(stage, 0, frame, points[frame])
        assert seen.min() > 0.04
        assert seen.max() < 0.96
    assert not stage.is_still
    assert stage.floor.spacing


def test_what_stands_beside_fits_too_at_the_same_scale():
    points, poses = walk(0.0)
    wide = np.array([[-2.0, 0.5, 0.0], [2.0, 0.5, 0.0], [0.0, 2.3, 0.0]])
    stage = set_stage(points, poses, parse_views(["front", "right"]), aspect=1.5, beside=wide)
    for view in range(2):
        camera = stage.camera_on(view, 3, np.zeros(3))
        seen = camera.project(wide, 150, 100)[:, :2] / (150, 100)
        assert seen.min() > 0.05
        assert seen.max() < 0.95
        offsets = [np.subtract(one.position, one.target) for one in (camera, stage.camera(view, 3))]
        np.testing.assert_allclose(*offsets)


def test_what_must_be_seen_too_is_seen_but_not_followed():
    points, poses = walk()
    also = points[:, :3].copy()
    also[20] += (0, 1.0, 0)
    also[40, :, 1] -= 0.5
    alone, both = (set_stage(points, poses, parse_views(["left"]), camera="follow", also=more) for more in (None, also))
    np.testing.assert_array_equal(both.shifts, alone.shifts)
    assert both.floor.height < alone.floor.height
    assert places(alone, 0, 20, also[20]).min() < 0.05 <= places(both, 0, 20, also[20]).min()


def test_views_and_turntables_that_cannot_be_shown_are_rejected():
    assert [view.label for view in parse_views(["top", "45", "-30.5"])] == ["top", "45°", "-30.5°"]
    for names, message in (
        (["frnt"], "views: wanted front, left, back, right, top or degrees .* got 'frnt'; did you mean 'front'"),
        ([], "views: wanted 1 to 8"),
        (["front"] * 9, "views: wanted 1 to 8"),
        (["left", "left"], "views: wanted each view once, got 'left' twice"),
        (["400"], "degrees from -360 to 360, got '400'"),
        (["nan"], "got 'nan'"),
    ):
        with pytest.raises(UserError, match=message):
            parse_views(names)
    assert parse_turntable("False") == 0
    assert parse_turntable("true") == pytest.approx(math.pi / 4)
    assert parse_turntable("-90") == pytest.approx(-math.pi / 2)
    for text in ("fast", "nan", "1000", ""):
        with pytest.raises(UserError, match="turntable: wanted true, false or degrees per second up to 720"):
            parse_turntable(text)


def test_panels_stand_side_by_side_with_labels_and_say_how_large_they_are():
    points, poses = walk(0.0)
    stage = set_stage(points, poses, parse_views(["front", "left", "back"]))
    screen = Screen(stage, (40, 50), {"avatar": "avatar", "canonical": "canonical shape"}, settled=["canonical"])
    picture = screen.draw(0, {"avatar": None, "canonical": None})
    assert picture.shape == (*picture_size((40, 50), 2, 3)[::-1], 3)
    assert picture.shape[1] == 3 * 40 + 2
    assert picture.shape[0] > 2 * 50
    assert picture[50:].min() < 120  # ink
    assert Screen(stage, (40, 50), {"a": "a", "b": "b"}).columns == 3
    single = Screen(set_stage(points, poses, parse_views(["front"])), (40, 50), {"avatar": "avatar"})
    assert single.draw(0, {"avatar": None}).shape == (50, 40, 3)
    with pytest.raises(UserError, match=r"video_size: wanted .* 12 panels of 1024 x 2048; give a smaller video_size"):
        picture_size((1024, 2048), 3, 4)
