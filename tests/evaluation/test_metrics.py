"""IoU against sets counted by hand, and every mean by its definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from snarfcli.evaluation.metrics import (
    FrameMetrics,
    group_by_sequence,
    in_box,
    iou,
    mean_of_sequences,
    summarise,
)


def mask(text: str) -> np.ndarray:
    """Return `#.` as a bool array."""
    return np.array([letter == "#" for letter in text], dtype=bool)


@pytest.mark.parametrize(
    ("predicted", "occupied", "wanted"),
    [
        ("##..", "##..", 1.0),
        ("##..", "..##", 0.0),
        ("##..", ".##.", 1 / 3),
        ("####", "#...", 1 / 4),
        ("....", "#...", 0.0),
        ("#...", "....", 0.0),
        ("....", "....", 1.0),  # two empty sets agree
        ("", "", 1.0),
    ],
)
def test_iou_of_small_sets(predicted, occupied, wanted):
    assert iou(mask(predicted), mask(occupied)) == wanted


def test_only_chosen_points_count():
    assert iou(mask("##.#"), mask(".###"), mask("####")) == 2 / 4
    assert iou(mask("##.#"), mask(".###"), mask("##..")) == 1 / 2
    assert iou(mask("##.#"), mask(".###"), mask("....")) == 1.0


def test_many_frames_at_once():
    predicted = np.stack([mask("##.."), mask("...."), mask("#...")])
    occupied = np.stack([mask(".##."), mask("...."), mask("##..")])
    np.testing.assert_array_equal(iou(predicted, occupied), [1 / 3, 1.0, 1 / 2])


def test_iou_agrees_with_python_sets():
    random = np.random.default_rng(0)
    for _ in range(20):
        predicted, occupied = random.random((2, 50)) < random.random((2, 1))
        a, b = set(np.flatnonzero(predicted)), set(np.flatnonzero(occupied))
        assert iou(predicted, occupied) == pytest.approx(len(a & b) / len(a | b), abs=1e-15)


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"occupied: wanted shape \[3\], .* got \[4\]"):
        iou(mask("#.."), mask("#..."))
    with pytest.raises(TypeError, match="predicted: wanted an array of bools, got float64"):
        iou(np.zeros(3), mask("#.."))
    with pytest.raises(ValueError, match="frames: wanted at least one frame"):
        summarise([])


def test_the_border_of_a_box_is_inside():
    points = np.array([[0, 0, 0], [1, 2, 3], [0.5, 1, 1], [1.1, 1, 1], [0.5, -0.1, 1], [0.5, 1, 3.5]])
    np.testing.assert_array_equal(in_box(points, np.zeros(3), np.array([1, 2, 3])), mask("###..."))


FRAME = FrameMetrics("walk", 0, 0, 0.9, 0.8, 0.7, 100, 90, 20, 40, 10, 1, 0.1, 0.2, 0.5)
WALK = [FRAME, replace(FRAME, index=1, frame=4, iou_bbox=0.5, iou_surface=0.4, iou_tight_box=0.3)]
JUMP = [FrameMetrics("jump", 0, 0, 0.1, 0.2, 0.3, 100, 0, 0, 100, 0, 0, 0.1, 0.2, 0.5)]


def test_correspondences_are_counted_over_the_points_that_have_any():
    summary = summarise(WALK + JUMP)
    assert summary.correspondences_per_point == pytest.approx(180 / 120)
    assert summary.several == pytest.approx(40 / 300)


def test_every_frame_counts_the_same():
    summary = summarise(WALK + JUMP)
    assert summary.frames == 3
    assert summary.iou_bbox == pytest.approx((0.9 + 0.5 + 0.1) / 3)
    assert summary.iou_surface == pytest.approx((0.8 + 0.4 + 0.2) / 3)
    assert summary.iou_tight_box == pytest.approx((0.7 + 0.3 + 0.3) / 3)
    assert summary.worst_iou_surface == 0.2
    assert summary.without == pytest.approx((40 + 40 + 100) / 300)
    assert summary.inside_without == pytest.approx(2 / 20)
    assert (summary.search_s, summary.shape_s, summary.total_s) == pytest.approx((0.3, 0.6, 1.5))


def test_every_sequence_counts_the_same():
    assert mean_of_sequences(WALK + JUMP) == pytest.approx(
        {"iou_bbox": (0.7 + 0.1) / 2, "iou_surface": (0.6 + 0.2) / 2, "iou_tight_box": (0.5 + 0.3) / 2}
    )


def test_nothing_inside_loses_nothing():
    assert summarise(JUMP).inside_without == 0.0


def test_sequences_keep_their_order():
    groups = group_by_sequence([*JUMP, *WALK])
    assert {name: len(frames) for name, frames in groups.items()} == {"jump": 1, "walk": 2}
    assert list(groups) == ["jump", "walk"]
