"""Frames that cannot be trusted."""

from __future__ import annotations

import numpy as np
import pytest

from snarfcli.registration.matches import Agreement
from snarfcli.registration.trust import apart_share, find_jumps, is_suspicious, judge, usual_misfit

NAMES = ("root", "hand")


def moving(frames: int = 40) -> np.ndarray:
    """Return joints [T, 2, 3] of a hand that circles a root, metres."""
    joints = np.zeros((frames, 2, 3))
    angle = 0.2 * np.arange(frames)
    joints[:, 1, 0], joints[:, 1, 1] = 0.6 * np.cos(angle), 0.6 * np.sin(angle)
    return joints


def test_a_steady_motion_has_no_jumps():
    assert (find_jumps(moving()) == -1).all()
    assert find_jumps(moving(2)).tolist() == [-1, -1]


def test_a_joint_that_jumps_there_and_back_is_named():
    joints = moving()
    joints[20, 1, 2] += 0.4
    assert np.flatnonzero(find_jumps(joints) >= 0).tolist() == [20]
    assert find_jumps(joints)[20] == 1


def test_a_frame_is_compared_with_its_neighbours():
    misfit = np.full(200, 0.04)
    misfit[120:] = 0.048  # another pose, in which the body agrees less
    misfit[50] = 0.055
    assert np.flatnonzero(is_suspicious(misfit)).tolist() == [50]
    assert usual_misfit(misfit)[180] == 0.048


def test_a_long_lost_stretch_does_not_become_usual():
    misfit = np.full(400, 0.04)
    misfit[100:250] = 0.09
    assert np.flatnonzero(is_suspicious(misfit)).tolist() == list(range(100, 250))


def test_reasons_are_plain_words():
    misfit, residual = np.full(10, 0.04), np.full(10, 0.012)
    misfit[3], residual[3] = 0.1, 0.031
    apart = np.full(10, 0.003)
    apart[9] = 0.06
    jumps = np.full(10, -1)
    jumps[[4, 7]] = 1  # that of frame 4 comes from its neighbour
    reasons = judge(misfit, residual, apart, jumps, NAMES)
    assert reasons[3] == "the body is 31.0 mm from the points; usual in this sequence: 12.0 mm"
    assert reasons[7] == "joint hand jumps between this frame and its neighbours"
    assert [index for index, reason in enumerate(reasons) if reason] == [3, 7, 9]
    assert reasons[9] == "6 % of the body and of the points are far from each other"


def test_a_sequence_that_is_lost_from_end_to_end_is_not_trusted():
    misfit, residual, apart = np.full(10, 0.13), np.full(10, 0.006), np.full(10, 0.08)
    assert all(judge(misfit, residual, apart, np.full(10, -1), NAMES))
    assert not any(judge(misfit, residual, np.zeros(10), np.full(10, -1), NAMES))
    apart[6:] = 0.02
    assert judge(misfit, residual, apart, np.full(10, -1), NAMES)[6:] == ("most frames of this sequence are lost",) * 4


@pytest.mark.parametrize(("of_body", "of_scan", "share"), [(0.2, 0.1, 0.1), (0.0, 0.3, 0.0), (0.3, 0.0, 0.0)])
def test_only_what_both_sides_miss_is_apart(of_body, of_scan, share):
    body, seen = (np.where(np.arange(100) < 100 * part, 0.2, 0.01) for part in (of_body, of_scan))
    found = Agreement(0.2, 0.04, 0.002, body, seen, np.zeros(100, np.intp))
    grid = 0.02 * np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0), [0.0]), -1).reshape(-1, 3)
    assert apart_share(found, grid, grid) == pytest.approx(share)
    assert apart_share(found, grid, grid, clothes_m=0.15) == 0
    assert apart_share(found, grid, 4 * grid) == 0  # so few points are far from all
    assert apart_share(found, 7 * grid, grid) == 0
