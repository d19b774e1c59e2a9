"""What stands on the stage after each picture, without anybody who looks at it."""

from __future__ import annotations

import numpy as np
import pytest
from torch import Tensor
from toy_avatar import RADIUS
from toy_viewer import PATIENCE_S, Watched

from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.viewer.gate import Gate
from snarfcli.viewer.picture import Picture
from snarfcli.viewer.scene import ViewerScene

viser = pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")


@pytest.fixture
def server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def watched():
    watched = Watched()
    yield watched
    watched.state.stop()


@pytest.fixture
def scene(server, watched) -> ViewerScene:
    return ViewerScene(server, Gate(), watched.state, lambda joint: None, lambda: watched.now)


def grown_as_bent(surface: SkinnedSurface, pose: Tensor) -> np.ndarray:
    """Canonical vertices of a shape that grows with the bend of joint 1."""
    return surface.mesh.vertices * np.float32(1 + pose[1, 2])


def show_settled(scene: ViewerScene, watched: Watched) -> Picture:
    """Show all pictures until nothing more is being made, as the server does; return the last one."""
    while True:
        watched.woken.clear()
        picture = watched.picture()
        scene.show(picture)
        if not picture.is_computing:
            break
        assert watched.woken.wait(PATIENCE_S)
    watched.now += 1  # for coloured meshes to be loaded
    scene.advance()
    return picture


def test_a_look_that_changes_between_picture_and_stage_is_not_lost(scene, watched):
    show_settled(scene, watched)
    picture = watched.picture()
    watched.state.change_look(weight_colors=True, shows_skeleton=True)
    scene.show(picture)
    assert scene._body._plain.visible
    assert scene._skeleton_nodes is None
    show_settled(scene, watched)
    assert not scene._body._plain.visible
    assert scene._skeleton_nodes.joints.visible
    assert [node.visible for node in scene._body._colored if node is not None] == [True]


def test_the_shape_beside_a_field_is_that_of_its_pose(scene, watched, monkeypatch):
    monkeypatch.setattr(SkinnedSurface, "canonical_vertices", grown_as_bent)
    watched.state.change_look(surface="field", shows_canonical=True)
    show_settled(scene, watched)
    for bend in (0.3, 0.6):
        watched.state.turn_joint(1, np.array([0.0, 0.0, bend]))
        picture = show_settled(scene, watched)
        assert picture.mesh.surface == "field"
        assert np.ptp(scene._canonical._plain.vertices[:, 1]) == pytest.approx((1 + bend) * 2 * RADIUS, abs=0.02)


def test_the_shape_beside_stands_on_the_floor_wherever_that_is(scene, watched):
    watched.state.change_look(has_pose_shape=False, shows_canonical=True)
    show_settled(scene, watched)
    watched.state.floor_y -= 0.5
    show_settled(scene, watched)
    feet = scene._canonical._plain.vertices[:, 1].min() + scene._canonical._frame.position[1]
    assert feet == pytest.approx(watched.state.floor_y)


def test_the_handle_follows_the_joint_unless_a_client_drags_it(scene, watched):
    straight, quarter = np.array([1.0, 0, 0, 0]), np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    watched.state.change_look(shows_skeleton=True)
    scene.chosen_joint = 1
    show_settled(scene, watched)
    for client_id in (3, 4):
        scene.turn_chosen(quarter, is_over=False, client_id=client_id)
    scene.turn_chosen(quarter, is_over=True, client_id=4)
    show_settled(scene, watched)
    np.testing.assert_allclose(watched.state.posed.pose[1], (0, 0, np.pi / 2), atol=1e-6)
    np.testing.assert_allclose(scene._skeleton_nodes.handle.wxyz, straight, atol=1e-6)  # as on the page that turns it
    scene.let_go(3)
    show_settled(scene, watched)
    np.testing.assert_allclose(scene._skeleton_nodes.handle.wxyz, quarter, atol=1e-6)
