"""A body followed through frames that share one topology."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from snarfcli.bodies import builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.same_topology import (
    OTHERS,
    EdgeLengths,
    NoUsualFrames,
    fit_one_topology,
    is_own_topology,
    prepare_follower,
)

BETAS = np.array([1.0, -1.0, 0.5, 0.5] + [0.0] * 6)
FRAMES = 12
FACES = builtin_body().faces.numpy()


@pytest.fixture(scope="module")
def surface() -> BodySurface:
    return BodySurface.from_body(builtin_body(), 10**6)


@pytest.fixture(scope="module")
def true() -> list[BodyState]:
    draws = np.random.default_rng(1)
    ends = draws.normal(0, 0.4, (2, 24, 3))
    shares = np.sin(np.linspace(0, 3, FRAMES))[:, None, None], np.cos(np.linspace(0, 5, FRAMES))[:, None, None]
    poses = shares[0] * ends[0] + shares[1] * ends[1]
    return [BodyState.from_pose(pose, np.array([0.1 * frame, 1.0, 0.0]), BETAS) for frame, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def frames(true) -> np.ndarray:
    body = builtin_body().to(torch.float64)
    pose = torch.from_numpy(np.stack([state.pose for state in true]))
    translation = torch.from_numpy(np.stack([state.translation for state in true]))
    return body.pose(pose, BETAS, translation).vertices.numpy().astype(np.float32)


@pytest.fixture(scope="module")
def other(frames) -> tuple[np.ndarray, np.ndarray]:
    """Frames of another topology, and their faces: the vertices in another order, and a hole."""
    order = np.random.default_rng(2).permutation(frames.shape[1])
    place = np.argsort(order)
    return frames[:, order], place[FACES[800:]]


def errors_m(surface: BodySurface, fitted, true) -> np.ndarray:
    states = [
        BodyState.from_pose(pose, translation, fitted.betas)
        for pose, translation in zip(fitted.poses, fitted.translation, strict=True)
    ]
    return np.array(
        [
            np.linalg.norm(surface.joints(one) - surface.joints(other), axis=1).mean()
            for one, other in zip(states, true, strict=True)
        ]
    )


def test_frames_of_the_body_itself_need_no_known_pose(surface, frames, true):
    done = []
    fitted = fit_one_topology(surface, FACES, FACES, lambda frame: frames[frame], FRAMES, {}, on_frame=done.append)
    assert errors_m(surface, fitted, true).max() < 0.001
    np.testing.assert_allclose(fitted.betas, BETAS, atol=0.1)
    assert fitted.is_trusted.all()
    assert fitted.reasons == ("",) * FRAMES
    assert fitted.residual_m.max() < 0.001
    assert fitted.objective.shape == (FRAMES,)
    assert sorted(done) == list(range(FRAMES))


def test_frames_of_another_topology_follow_a_known_pose(surface, other, true):
    vertices, faces = other
    draws = np.random.default_rng(5)
    wrong = BodyState.from_pose(true[3].pose + draws.normal(0, 0.01, (24, 3)), true[3].translation, BETAS + 0.1)
    fitted = fit_one_topology(surface, FACES, faces, lambda frame: vertices[frame], FRAMES, {3: wrong})
    assert errors_m(surface, fitted, true).mean() < 0.004
    assert fitted.is_trusted.all()


def test_a_given_shape_is_kept(surface, frames, true):
    fitted = fit_one_topology(surface, FACES, FACES, lambda frame: frames[frame], FRAMES, {}, betas=BETAS)
    np.testing.assert_array_equal(fitted.betas, BETAS)
    assert errors_m(surface, fitted, true).max() < 5e-4


def test_another_topology_needs_a_known_pose(surface, other):
    vertices, faces = other
    with pytest.raises(ValueError, match="states: wanted those of some frames"):
        fit_one_topology(surface, FACES, faces, lambda frame: vertices[frame], FRAMES, {})


def test_a_known_pose_of_other_vertices_is_none(surface, other, true):
    vertices, faces = other
    mixed = list(vertices)
    mixed[0] = vertices[0][::-1]
    with pytest.raises(NoUsualFrames, match="states: wanted those of some frames"):
        fit_one_topology(surface, FACES, faces, lambda frame: mixed[frame], FRAMES, {0: true[0]}, betas=BETAS)


def test_permuted_and_other_frames_are_noticed_and_fitted_alone(surface, frames, true):
    mixed = list(frames)
    mixed[4] = frames[4][np.random.default_rng(0).permutation(len(frames[4]))]
    mixed[7] = frames[7][:-1]
    mixed[8] = np.full_like(frames[8], np.nan)
    follower = prepare_follower(surface, FACES, FACES, [frames[0], frames[5], frames[11]], [], betas=BETAS)
    left = follower.follow(lambda frame: mixed[frame], FRAMES)
    assert left.reasons == tuple(OTHERS if frame in (4, 7, 8) else "" for frame in range(FRAMES))
    assert left.is_trusted.tolist() == [not reason for reason in left.reasons]
    assert np.isfinite(left.poses).all()
    asked = {}

    def refit(frame: int, near: Sequence[BodyState]) -> Any:
        asked[frame] = near
        agreement = SimpleNamespace(residual_m=0.004, objective=0.2)
        return None if frame == 8 else SimpleNamespace(state=true[frame], agreement=agreement)

    fitted = follower.follow(lambda frame: mixed[frame], FRAMES, refit=refit)
    assert sorted(asked) == [4, 7, 8]
    near = surface.joints(asked[4][0]), surface.joints(asked[4][1])
    np.testing.assert_allclose(near, [surface.joints(true[3]), surface.joints(true[5])], atol=1e-3)
    assert fitted.reasons == tuple(OTHERS if frame == 8 else "" for frame in range(FRAMES))
    assert fitted.residual_m[4] == 0.004
    assert errors_m(surface, fitted, true)[[4, 7]].max() < 1e-6


def test_a_first_frame_that_differs_from_all_others(surface, frames):
    broken = [np.full_like(frames[0], np.nan), frames[0][::-1], *frames[:3]]
    follower = prepare_follower(surface, FACES, FACES, broken, [], betas=BETAS)
    fitted = follower.follow(lambda frame: broken[frame], 5)
    assert fitted.is_trusted.tolist() == [False, False, True, True, True]
    with pytest.raises(ValueError, match="wanted finite vertices"):
        prepare_follower(surface, FACES, FACES, broken[:1], [], betas=BETAS)


def test_frames_that_do_not_move_like_the_body_are_not_trusted(surface, frames):
    follower = prepare_follower(surface, FACES, FACES, list(frames[:4]), [], betas=BETAS)
    bent = frames[6] + np.array([0, 0, 0.2]) * np.sin(4 * frames[6][:, 1:2])
    fitted = follower.follow(lambda frame: [frames[5], bent][frame], 2)
    assert fitted.is_trusted.tolist() == [True, False]
    assert "mm from the body on average" in fitted.reasons[1]


def test_a_sequence_of_other_vertices_only_is_an_error(surface, frames):
    follower = prepare_follower(surface, FACES, FACES, list(frames[:4]), [], betas=BETAS)
    with pytest.raises(ValueError, match="got none"):
        follower.follow(lambda frame: frames[frame][:-1], 3)


def test_edges_tell_the_order_of_vertices(frames):
    edges = EdgeLengths(frames[0], FACES)
    assert all(edges.fit(vertices) for vertices in frames)
    order = np.arange(len(frames[1]))
    order[:2000] = np.roll(order[:2000], 1)
    assert not edges.fit(frames[1][order])
    assert not edges.fit(100 * frames[1])


def test_own_topology():
    count = int(FACES.max()) + 1
    assert is_own_topology(FACES, count, FACES.copy())
    assert not is_own_topology(FACES, count + 1, FACES)
    assert not is_own_topology(FACES, count, FACES[:, [1, 2, 0]])
