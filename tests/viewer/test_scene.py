"""What stands on the stage after each picture, without anybody who looks at it."""

from __future__ import annotations

import contextlib
import io

import pytest
from toy_viewer import PATIENCE, Watched

from snarfcli.viewer.picture import Picture
from snarfcli.viewer.scene import Scene

viser = pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")


@pytest.fixture
def server():
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        yield server
        server.stop()


@pytest.fixture
def watched():
    watched = Watched()
    yield watched
    watched.viewing.stop()


@pytest.fixture
def scene(server, watched) -> Scene:
    return Scene(server, watched.viewing, lambda joint: None, lambda: watched.now)


def show_settled(scene: Scene, watched: Watched) -> Picture:
    """Show all pictures until nothing more is being made, as the server does; return the last one."""
    while True:
        watched.woken.clear()
        picture = watched.picture()
        scene.show(picture)
        if not picture.is_computing:
            break
        assert watched.woken.wait(PATIENCE)
    watched.now += 1  # for coloured meshes to be loaded
    scene.advance()
    return picture


def test_a_look_that_changes_between_picture_and_stage_is_not_lost(scene, watched):
    show_settled(scene, watched)
    picture = watched.picture()
    watched.viewing.change_look(weight_colors=True, shows_skeleton=True)
    scene.show(picture)
    assert scene._body._plain.visible and scene._joints is None
    show_settled(scene, watched)
    assert not scene._body._plain.visible and scene._joints.visible
    assert [node.visible for node in scene._body._colored if node is not None] == [True]
