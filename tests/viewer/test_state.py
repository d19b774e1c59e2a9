"""The picture for a state of the viewer: without a page, with a clock set by the test."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from toy_avatar import LENGTH, RADIUS, ToyAvatar
from toy_viewer import PATIENCE_S, SMALL, Watched

from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.motions import Motion
from snarfcli.viewer.body import CanonicalRequest, FieldRequest, ShapeRequest

BEND = np.array([0.0, 0.0, 0.9])


@pytest.fixture
def watched():
    watched = Watched()
    yield watched
    watched.state.stop()


def bending(frames: int = 4, rate: float = 10.0) -> Motion:
    poses = np.zeros((frames, 2, 3))
    poses[:, 1, 2] = np.linspace(0, 0.9, frames)
    way = np.stack([np.arange(frames) * 0.5, np.full(frames, 2.0), np.zeros(frames)], 1)
    return Motion("bend", poses, way, rate)


def test_the_first_picture_has_no_surface_and_the_next_one_stands_on_the_floor(watched):
    first = watched.picture()
    assert first.mesh is None
    assert first.is_computing
    assert first.message is None
    picture = watched.settled()
    assert picture.mesh.surface == "skinned"
    assert picture.mesh.weights is None
    assert picture.canonical is None
    assert picture.mesh.vertices[:, 1].min() == pytest.approx(watched.state.floor_y, abs=1e-4)


def test_a_turned_joint_moves_the_skin_at_once(watched):
    before = watched.settled().mesh
    watched.state.turn_joint(1, BEND)
    after = watched.picture().mesh
    assert after.faces is before.faces
    assert after.posed.pose[1, 2] == 0.9
    exact = SkinnedSurface(watched.avatar, 24).posed(torch.from_numpy(after.posed.pose).float())
    np.testing.assert_allclose(watched.settled().mesh.vertices, exact.vertices, atol=1e-5)


def test_the_shape_of_the_pose_comes_when_it_is_made(watched, monkeypatch):
    grown = []

    def canonical_vertices(self, pose):
        grown.append(float(pose[1, 2]))
        return self.mesh.vertices + np.float32(0.01) * self.mesh.normals

    watched.settled()
    monkeypatch.setattr(SkinnedSurface, "canonical_vertices", canonical_vertices)
    before = watched.state.picture()[0].mesh.vertices
    watched.state.turn_joint(1, np.zeros(3))  # the same pose, chosen anew
    after = watched.settled().mesh
    np.testing.assert_allclose(np.linalg.norm(after.vertices - before, axis=1), 0.01, atol=1e-3)
    assert grown == [0.0]
    assert after.seconds is not None
    watched.state.change_look(has_pose_shape=False)
    plain = watched.settled().mesh
    np.testing.assert_allclose(plain.vertices, before, atol=1e-5)
    assert grown == [0.0]
    assert plain.seconds is None


def test_a_field_is_made_for_the_latest_pose_only(watched, monkeypatch):
    watched.settled()
    begun, go_on, made = threading.Event(), threading.Event(), []
    make = watched.state.body.make

    def slow(request):
        begun.set()
        assert go_on.wait(PATIENCE_S)
        made.append(request.posed.pose[1, 2])
        return make(request)

    monkeypatch.setattr(watched.state._worker, "_work", slow)
    watched.state.change_look(surface="field")
    picture = watched.picture()
    assert picture.is_computing
    assert picture.mesh.surface == "skinned"
    assert begun.wait(PATIENCE_S)
    for angle in (0.1, 0.2, 0.3):
        watched.state.turn_joint(1, angle * BEND / 0.9)
        assert watched.picture().mesh.posed.pose[1, 2] == pytest.approx(angle)
    go_on.set()
    picture = watched.settled()
    assert made == [0, pytest.approx(0.3)]
    assert picture.mesh.surface == "field"
    assert picture.mesh.seconds > 0
    assert picture.mesh.posed.pose[1, 2] == pytest.approx(0.3)
    assert picture.mesh.vertices[:, 1].max() > RADIUS
    assert watched.picture().mesh.faces is picture.mesh.faces


def test_a_field_in_colour_has_weights_and_another_resolution_is_made_anew(watched):
    watched.state.change_look(surface="field", weight_colors=True)
    coarse = watched.settled().mesh
    assert coarse.surface == "field"
    assert coarse.weights.shape == (len(coarse.vertices), 2)
    watched.state.change_look(field_resolution=40)
    assert len(watched.settled().mesh.vertices) > 1.5 * len(coarse.vertices)
    watched.state.change_look(surface="skinned", skinned_resolution=40)
    assert watched.settled().mesh.weights is not None


def test_a_pose_without_surface_is_told_and_the_viewer_goes_on(watched, caplog):
    query = watched.avatar.query

    def sometimes(points, transforms, pose):
        samples = query(points, transforms, pose)
        if pose[0, 1, 2] > 0.5:
            samples.logits = samples.logits * 0 - 1
        return samples

    watched.avatar.query = sometimes
    watched.state.change_look(surface="field")
    assert watched.settled().message is None
    watched.state.turn_joint(1, BEND)
    picture = watched.settled()
    assert "unoccupied" in picture.message
    assert picture.mesh.surface == "skinned"
    watched.state.turn_joint(1, BEND / 2)
    assert watched.settled().message is None
    assert watched.settled().mesh.surface == "field"
    assert not caplog.records

    def broken(points, transforms, pose):
        raise RuntimeError("out of memory")

    watched.avatar.query = broken
    watched.state.turn_joint(1, BEND / 3)
    assert watched.settled().message == "out of memory"
    assert "continues after: RuntimeError" in caplog.text


def test_an_avatar_without_any_surface_is_told_too():
    watched = Watched(ToyAvatar(radius=-1.0))
    picture = watched.settled()
    assert picture.mesh is None
    assert picture.message
    watched.state.stop()


def test_an_avatar_without_weights_shows_its_field_only():
    avatar = ToyAvatar()
    avatar.model.has_skinning_weights = False
    watched = Watched(avatar, replace(SMALL, weight_colors=True, shows_canonical=True))
    first = watched.settled()
    assert first.mesh.surface == "field"
    assert first.mesh.weights is None
    assert first.canonical is None
    watched.state.turn_joint(1, BEND)
    meanwhile = watched.picture()
    assert meanwhile.is_computing
    assert meanwhile.mesh.posed is first.mesh.posed
    assert watched.settled().mesh.posed.pose[1, 2] == 0.9
    watched.state.stop()


def test_a_motion_plays_and_a_changed_pose_holds_it(watched):
    state = watched.state
    watched.settled()
    state.load_motion(bending())
    assert state.floor_y == pytest.approx(2 - RADIUS, abs=0.02)
    state.play()
    seen = []
    for watched.now in (0.0, 0.12, 0.25, 0.41):
        picture, wait = state.picture()
        assert picture.is_playing
        assert 0 < wait <= 0.1
        seen.append((picture.frame, picture.posed.translation[0]))
    assert seen == [(0, 0.0), (1, 0.5), (2, 1.0), (0, 0.0)]
    watched.now = 0.72
    state.turn_joint(0, np.array([0.0, 0.3, 0.0]))  # starts from the frame that was due
    picture, wait = state.picture()
    assert not picture.is_playing
    assert wait is None
    assert picture.frame == 3
    np.testing.assert_allclose(picture.posed.pose, [(0, 0.3, 0), (0, 0, 0.9)])
    assert picture.posed.translation[0] == 1.5
    state.seek(1)
    np.testing.assert_allclose(state.picture()[0].posed.pose, bending().poses[1])
    state.load_motion(None)
    state.play()
    assert not state.picture()[0].is_playing


def test_a_field_while_playing_is_the_last_one_made(watched):
    watched.settled()
    watched.state.change_look(surface="field")
    watched.settled()
    watched.state.load_motion(bending())
    watched.state.play()
    watched.now = 0.25
    picture = watched.picture()
    assert picture.frame == 2
    assert picture.mesh.surface == "field"
    assert picture.shown.number < picture.posed.number
    watched.state.pause()
    assert watched.settled().shown.number == picture.posed.number


class AtOnce:
    """A worker that is ready with each request before anybody asks again."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self.kinds: list[type] = []
        self._work, self._outcome = work, None

    def start(self, request: Any) -> bool:
        self.kinds.append(type(request))
        self._outcome = request, self._work(request), None
        return True

    def take(self) -> tuple[Any, Any, None] | None:
        outcome, self._outcome = self._outcome, None
        return outcome


def test_the_canonical_shape_follows_while_a_field_plays(watched, monkeypatch):
    worker = AtOnce(watched.state.body.make)
    with monkeypatch.context() as patch:
        patch.setattr(watched.state, "_worker", worker)
        watched.state.change_look(surface="field", shows_canonical=True)
        for _ in range(4):
            watched.picture()
        assert worker.kinds == [CanonicalRequest, FieldRequest, ShapeRequest]
        watched.state.load_motion(bending(16, rate=40.0))
        watched.state.play()
        worker.kinds.clear()
        for watched.now in 0.026 * np.arange(1, 9):  # one frame each; at least 0.1 s between two shapes
            watched.picture()
        assert worker.kinds == [*[FieldRequest] * 3, ShapeRequest] * 2


def test_over_one_spot(watched):
    watched.state.load_motion(bending())
    watched.state.seek(2)
    watched.state.change_look(is_in_place=True)
    assert watched.state.posed.translation.tolist() == [0, 2, 0]
    watched.state.change_look(is_in_place=False)
    assert watched.state.posed.translation.tolist() == [1, 2, 0]


def test_joints_that_stretch_follow_their_own_transforms_until_posed_by_hand(watched):
    watched.settled()
    transforms = np.tile(np.eye(4, dtype=np.float32), (4, 2, 1, 1))
    transforms[3, 1, 0, 3] = 0.25
    transforms[:, :, 0, 3] += 0.5
    motion = replace(bending(), poses=np.zeros((4, 2, 3)), translation=np.tile([0.5, 0, 0], (4, 1)))
    watched.state.load_motion(motion, transforms)
    watched.state.seek(3)
    assert watched.picture().mesh.vertices[:, 0].max() == pytest.approx(2 * LENGTH + RADIUS + 0.75, abs=0.02)
    watched.state.change_look(is_in_place=True)
    assert watched.picture().mesh.vertices[:, 0].max() == pytest.approx(2 * LENGTH + RADIUS + 0.25, abs=0.02)
    watched.state.turn_joint(1, np.zeros(3))
    assert watched.picture().mesh.vertices[:, 0].max() == pytest.approx(2 * LENGTH + RADIUS, abs=0.02)


def test_reset_mirror_and_height(watched):
    state = watched.state
    state.load_motion(bending())
    state.seek(3)
    state.mirror_joint(1)  # without a counterpart nothing changes
    assert state.posed.pose[1, 2] == pytest.approx(0.9)
    state.move_root(1, 2.5)
    assert state.posed.translation.tolist() == [1.5, 2.5, 0]
    state.reset_pose()
    picture = watched.settled()
    assert not picture.posed.pose.any()
    assert picture.posed.translation[[0, 2]].tolist() == [0, 0]
    state.reset_pose()  # now that the skin is known: exactly on the floor
    assert watched.settled().mesh.vertices[:, 1].min() == pytest.approx(state.floor_y, abs=1e-3)


def test_the_canonical_shape_beside_it(watched):
    watched.state.change_look(shows_canonical=True)
    watched.state.turn_joint(1, BEND)
    picture = watched.settled()
    assert np.ptp(picture.canonical.vertices[:, 0]) == pytest.approx(2 * (LENGTH + RADIUS), abs=0.02)
    assert picture.canonical.weights is not None
