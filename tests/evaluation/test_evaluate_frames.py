"""Evaluation of an analytic ball against points labelled by another ball."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from snarfcli.errors import UserError
from snarfcli.evaluation import evaluate as module
from snarfcli.evaluation.evaluate import choose_frames, choose_points, evaluate, measure_frame


class Balls:
    """A sequence of unit balls; half the points uniform in a cube of side 3, half near the surface."""

    num_points, num_uniform = 4000, 2000

    def __init__(self, name: str = "roll", num_frames: int = 3) -> None:
        self.name, self.num_frames = name, num_frames
        self.poses = np.zeros((num_frames, 1, 3), np.float32)
        self.bone_transforms = np.tile(np.eye(4, dtype=np.float32), (num_frames, 1, 1, 1))
        self.bone_transforms[:, 0, 0, 3] = np.arange(num_frames)
        self.frame_numbers = 4 * np.arange(num_frames)

    def points(self, frame, index=None):
        random = np.random.default_rng(frame)
        uniform = random.uniform(-1.5, 1.5, (self.num_uniform, 3))
        direction = random.normal(size=(self.num_points - self.num_uniform, 3))
        near = direction / np.linalg.norm(direction, axis=1, keepdims=True) * random.normal(1.0, 0.1, (len(direction), 1))
        points = np.concatenate([uniform, near]).astype(np.float32) + self.bone_transforms[frame, 0, :3, 3]
        return points if index is None else points[index]

    def occupancies(self, frame, index=None):
        return np.linalg.norm(self.points(frame, index) - self.bone_transforms[frame, 0, :3, 3], axis=1) < 1.0

    def box(self, frame):
        centre = self.bone_transforms[frame, 0, :3, 3]
        return centre - 1.0, centre + 1.0


class Clock:
    """Replaces `time`: advances by the times that the ball reports."""

    now = 0.0

    @classmethod
    def perf_counter(cls) -> float:
        return cls.now


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    monkeypatch.setattr(module, "time", Clock)


class BallAvatar:
    """A ball of any radius; points with a greater distance than `reach` have no correspondence."""

    device = torch.device("cpu")

    def __init__(self, radius: float = 1.0, reach: float = np.inf) -> None:
        self.radius, self.reach, self.calls = radius, reach, []

    def find(self, points, bone_transforms, pose):
        assert points.shape[0] == bone_transforms.shape[0] == pose.shape[0] == 1
        self.calls.append(points.shape[1])
        Clock.now += 1.0
        return (points - bone_transforms[:, 0, None, :3, 3]).norm(dim=-1)

    def shape_at(self, distance, pose):
        Clock.now += 2.0
        found = distance < self.reach
        return SimpleNamespace(logits=torch.where(found, self.radius - distance, -30.0), counts=found.long())


def test_the_right_ball_is_perfect():
    frames = evaluate(BallAvatar(), [Balls()])
    assert [(f.iou_bbox, f.iou_surface, f.iou_tight_box) for f in frames] == [(1.0, 1.0, 1.0)] * 3
    assert [f.frame for f in frames] == [0, 4, 8]
    assert all(f.without == 0 for f in frames)
    assert {f.search_s for f in frames} == {1.0}
    assert {f.shape_s for f in frames} == {2.0}
    assert {f.total_s for f in frames} == {3.0}


def test_a_small_ball_has_the_ious_that_its_counts_say():
    sequence = Balls()
    frame = measure_frame(BallAvatar(radius=0.8), sequence, 1)
    points = sequence.points(1) - sequence.bone_transforms[1, 0, :3, 3]
    distance = np.linalg.norm(points, axis=1)
    for measured, part in ((frame.iou_bbox, slice(0, 2000)), (frame.iou_surface, slice(2000, 4000))):
        # the smaller ball lies in the larger one, so its points are the intersection and the others' the union
        assert measured == (distance[part] < 0.8).sum() / (distance[part] < 1.0).sum()
    assert frame.iou_bbox == pytest.approx(0.8**3, abs=0.05)
    assert frame.inside == (distance < 1.0).sum()


def test_the_tight_box_leaves_out_what_lies_outside_it():
    sequence = Balls()
    frame = measure_frame(BallAvatar(radius=1.3), sequence, 2)
    points = (sequence.points(2) - sequence.bone_transforms[2, 0, :3, 3])[:2000]
    distance = np.linalg.norm(points, axis=1)
    in_box = (np.abs(points) <= 1).all(axis=1)
    assert frame.iou_tight_box == (distance < 1.0).sum() / (in_box & (distance < 1.3)).sum()
    assert frame.iou_bbox < frame.iou_tight_box < 1


def test_points_without_correspondence_are_counted_and_outside():
    sequence = Balls()
    frame = measure_frame(BallAvatar(reach=0.5), sequence, 0)
    distance = np.linalg.norm(sequence.points(0), axis=1)
    assert frame.without == (distance >= 0.5).sum()
    assert frame.inside_without == ((distance >= 0.5) & (distance < 1.0)).sum()
    assert frame.iou_bbox == (distance[:2000] < 0.5).sum() / (distance[:2000] < 1.0).sum()


def test_many_points_are_queried_in_parts(monkeypatch):
    whole = measure_frame(BallAvatar(radius=0.9), Balls(), 0)
    monkeypatch.setattr(module, "_POINTS_AT_ONCE", 1500)
    avatar = BallAvatar(radius=0.9)
    parts = measure_frame(avatar, Balls(), 0)
    assert avatar.calls == [1500, 1500, 1000]
    assert (parts.iou_bbox, parts.iou_surface, parts.search_s) == (whole.iou_bbox, whole.iou_surface, 3.0)


def test_fewer_points_stay_half_and_half():
    chosen = choose_points(4000, 2000, 100, seed=1)
    assert len(np.unique(chosen)) == 100
    assert (chosen < 2000).sum() == 50
    assert (np.diff(chosen) > 0).all()
    np.testing.assert_array_equal(chosen, choose_points(4000, 2000, 100, seed=1))
    assert not np.array_equal(chosen, choose_points(4000, 2000, 100, seed=2))
    assert choose_points(4000, 2000, None, 0) is None
    assert choose_points(4000, 2000, 4000, 0) is None

    avatar = BallAvatar(radius=0.8)
    frames = evaluate(avatar, [Balls()], points=1000)
    assert set(avatar.calls) == {1000}
    assert {f.points for f in frames} == {1000}
    sequence = Balls()
    uniform = choose_points(4000, 2000, 1000, 0)[:500]
    distance = np.linalg.norm(sequence.points(0, uniform), axis=1)
    assert frames[0].iou_bbox == (distance < 0.8).sum() / (distance < 1.0).sum()


def test_fewer_frames_are_evenly_spaced():
    sequences = [Balls("a", 10), Balls("b", 10)]
    assert [(s.name, i) for s, i in choose_frames(sequences, 4)] == [("a", 2), ("a", 7), ("b", 2), ("b", 7)]
    assert len(choose_frames(sequences)) == len(choose_frames(sequences, 99)) == 20
    frames = evaluate(BallAvatar(), sequences, max_frames=1)
    assert [(f.sequence, f.index, f.frame) for f in frames] == [("b", 0, 0)]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"max_frames": 0}, "max_frames: wanted at least 1"), ({"points": 1}, "points: wanted at least 2")],
)
def test_wrong_numbers_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        evaluate(BallAvatar(), [Balls()], **settings)


def test_nothing_to_evaluate_says_what_to_do():
    with pytest.raises(UserError, match="no frames to evaluate; run"):
        evaluate(BallAvatar(), [])
