"""One shape from several frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scanned_person import BETAS, PRIOR, Person, surface

from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.shape import different_frames, fit_shape


def disturbed(state: BodyState, amount: float, seed: int) -> BodyState:
    draws = np.random.default_rng(seed)
    return BodyState.from_pose(state.pose + draws.normal(0, amount, state.pose.shape), state.translation + 0.02, np.zeros(10))


def size_error_m(betas: np.ndarray) -> float:
    """Return the mean distance between the vertices of a shape and of the true one."""
    return float(np.linalg.norm(surface().points_by_beta @ (betas - BETAS), axis=1).mean())


@pytest.fixture(scope="module")
def person() -> Person:
    return Person("jumping_jacks", 5, frame_rate=4)


def test_all_frames_get_one_shape_near_the_true_one(person):
    frames = [(person[index], disturbed(person.states[index], 0.1, index)) for index in range(5)]
    found = fit_shape(surface(), frames, PRIOR)
    assert size_error_m(found.betas) < 0.006  # measured 0.004; 0.02 of a single free frame
    assert person.errors_m(list(found.states)).max() < 0.008
    for state in found.states:
        np.testing.assert_array_equal(state.betas, found.betas)


def test_a_lost_frame_does_not_change_the_shape(person):
    frames = [(person[index], disturbed(person.states[index], 0.1, index)) for index in range(5)]
    scan, state = frames[0]
    pose = state.pose
    pose[[16, 17], 2] += (2.0, -2.0)  # arms elsewhere
    lost = replace(state, rotations=BodyState.from_pose(pose, state.translation, state.betas).rotations)
    found = fit_shape(surface(), [(scan, lost), *frames[1:]], PRIOR)
    assert size_error_m(found.betas) < 0.008
    assert found.misfit[0] > 1.5 * np.median(found.misfit)


def test_no_frames_are_an_error():
    with pytest.raises(ValueError, match="at least one"):
        fit_shape(surface(), [], PRIOR)


def test_different_frames_leave_out_copies():
    joints = np.zeros((6, 3, 3))
    joints[3, 1] = 1.0
    joints[5, 2] = 2.0
    joints += np.arange(6)[:, None, None]  # places do not count
    assert different_frames(joints, 3).tolist() == [0, 3, 5]
    assert different_frames(joints, 9).tolist() == list(range(6))
