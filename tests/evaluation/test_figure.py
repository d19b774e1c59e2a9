"""Choice and drawing of the worst and best frames."""

from __future__ import annotations

import numpy as np
import pytest
from toy_avatar import LENGTH, RADIUS, ToyAvatar
from toy_subject import capsule_mesh

from snarfcli.evaluation.figure import EXTRA, MISSING, choose_extremes, draw_frame, write_figure
from snarfcli.evaluation.metrics import FrameMetrics


def frame(sequence: str, number: int, surface: float) -> FrameMetrics:
    """Return a frame of which only the name and the surface IoU matter."""
    return FrameMetrics(sequence, number, number, 0.9, surface, 0.9, 10, 10, 0, 0, 0, 0, 0.0, 0.0, 0.0)


def names(frames) -> list[tuple[str, int]]:
    """Return sequence and number of frames."""
    return [(f.sequence, f.frame) for f in frames]


def test_neighbours_of_the_worst_frame_are_not_shown_again():
    frames = [frame("walk", t, 0.5 + 0.001 * abs(t - 20)) for t in range(80)]
    worst, best = choose_extremes(frames, 3)
    assert names(worst) == [("walk", 20), ("walk", 19), ("walk", 30)]  # stretches of ten frames
    assert names(best) == [("walk", 79), ("walk", 69), ("walk", 59)]


def test_each_sequence_has_its_own_stretches():
    frames = [frame("walk", t, 0.5) for t in range(40)] + [frame("jump", t, 0.4 + t) for t in range(8)]
    worst, best = choose_extremes(frames, 2)
    assert names(worst) == [("jump", 0), ("walk", 0)]
    assert names(best) == [("jump", 7), ("jump", 6)]


@pytest.mark.parametrize(("count", "wanted"), [(1, (1, 0)), (2, (1, 1)), (3, (1, 1)), (4, (2, 2)), (20, (3, 3))])
def test_few_frames_are_shown_once(count, wanted):
    worst, best = choose_extremes([frame("walk", t, 0.1 * t) for t in range(count)], 3)
    assert (len(worst), len(best)) == wanted
    assert not set(names(worst)) & set(names(best))


class Capsule:
    """Samples of the surface of the straight toy avatar, longer by `longer` metres."""

    name, num_frames, num_points, num_uniform = "lie", 1, 2000, 2000

    def __init__(self, longer: float = 0.0) -> None:
        avatar = ToyAvatar()
        self.length = 2 * LENGTH + longer
        self.poses = np.zeros((1, 2, 3), np.float32)
        self.translation = np.zeros((1, 3), np.float32)
        self.bone_transforms = np.tile(np.eye(4, dtype=np.float32), (1, avatar.skeleton.num_joints, 1, 1))
        self.frame_numbers = np.array([0])
        self.surface, self.triangles = capsule_mesh(self.length, RADIUS)

    def vertices(self, index):
        return self.surface.astype(np.float32)

    def faces(self, index):
        return self.triangles

    def points(self, index, chosen=None):
        return np.random.default_rng(0).uniform((-0.1, -0.2, -0.2), (1.6, 0.2, 0.2), (2000, 3)).astype(np.float32)

    def occupancies(self, index, chosen=None):
        points = self.points(index)
        nearest = np.zeros_like(points)
        nearest[:, 0] = points[:, 0].clip(0, self.length)
        return np.linalg.norm(points - nearest, axis=1) < RADIUS


def count(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    """Return the number of pixels of exactly this colour."""
    return int((picture == color).all(axis=2).sum())


def test_the_right_capsule_has_no_wrong_points():
    sequence = Capsule()
    (truth, predicted, points), wrong = draw_frame(ToyAvatar(), sequence, 0, resolution=32, size=96)
    assert wrong == (0, 0)
    assert count(points, MISSING) == count(points, EXTRA) == 0
    # the same shape from the same camera, up to the voxels
    assert np.abs(truth.astype(int) - predicted).mean() < 4
    assert truth.std() > 5


def test_missing_and_extra_points_have_their_colours():
    longer, shorter = Capsule(0.4), Capsule(-0.4)
    (_, _, points), (missing, extra) = draw_frame(ToyAvatar(), longer, 0, resolution=32, size=96)
    assert missing > 20
    assert extra == 0
    assert count(points, MISSING) > 20
    assert count(points, EXTRA) == 0
    (_, _, points), (missing, extra) = draw_frame(ToyAvatar(), shorter, 0, resolution=32, size=96)
    assert missing == 0
    assert extra > 20
    assert count(points, EXTRA) > 0


def test_an_empty_field_leaves_its_place_empty(tmp_path, caplog):
    sequence = Capsule()
    avatar = ToyAvatar(radius=-1.0)
    pictures, (missing, extra) = draw_frame(avatar, sequence, 0, resolution=32, size=64)
    assert pictures[1] is None
    assert (missing, extra) == (sequence.occupancies(0).sum(), 0)
    assert "nothing to draw for lie, frame 0" in caplog.text
    write_figure(tmp_path / "frames.png", avatar, [sequence], [frame("lie", 0, 0.0)], resolution=32)
    assert [path.name for path in tmp_path.iterdir()] == ["frames.png"]
