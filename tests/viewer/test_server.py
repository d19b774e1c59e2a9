"""The page as its clients see it, over viser's own connection; no browser is needed."""

from __future__ import annotations

import queue
import re
import socket
import urllib.request
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from toy_avatar import ToyAvatar
from toy_viewer import PATIENCE_S, SMALL

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.motions import Motion
from snarfcli.viewer import server as server_module
from snarfcli.viewer.joints import angles_of
from snarfcli.viewer.server import ViewServer, can_open_browser, check_port
from snarfcli.viewer.state import ViewerState

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")

from viser_page import Page

FACTS = {"subject": "toy", "data": "none", "model": "capsules", "joints": "2"}


class OneJoint(ToyAvatar):
    """Both capsules hang on the root."""

    def __init__(self) -> None:
        super().__init__()
        self.skeleton = Skeleton(("root",), (-1,), torch.zeros(1, 3), torch.zeros(1, 3))

    def skinning_weights(self, points_c: torch.Tensor) -> torch.Tensor:
        return points_c.new_ones(len(points_c), 1)


def load_motion(name: str):
    if name == "broken":
        raise UserError("no such\nmotion")
    poses = np.zeros((4, 2, 3))
    poses[:, 1, 2] = 0.9 if name == "still" else np.linspace(0, 0.9, 4)
    motion = Motion(name, poses, np.zeros((4, 3)), 20.0)
    return (motion.slice(3) if name == "pose" else motion), None


@pytest.fixture
def server():
    server = ViewServer(ToyAvatar(), SMALL, motions=["bend", "pose", "broken"], load_motion=load_motion, facts=FACTS)
    yield server
    server.stop()


def test_the_page_is_served_on_this_machine_only_and_needs_no_other(server):
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/", timeout=300) as answer:
        page = answer.read()
    assert answer.status == 200
    assert b"<html" in page
    assert b'src="http' not in page
    assert b'href="http' not in page
    assert server.server.get_host() == "127.0.0.1"


HOSTILE = "{alert(1)} <img src=x onerror=alert(1)> [a](javascript:b) | \x1b]0;c\x07\n# d"


def broken_motion(name: str):
    raise UserError(f"no motion {name}")


def test_texts_of_a_downloaded_avatar_are_inert_on_the_page():
    facts = {"subject": HOSTILE, "data": HOSTILE, HOSTILE: HOSTILE}
    avatar = ToyAvatar()
    avatar.skeleton = replace(avatar.skeleton, names=("root", HOSTILE))
    server = ViewServer(avatar, SMALL, motions=[HOSTILE, "x" * 10**5], load_motion=broken_motion, facts=facts)
    try:
        with Page(server) as page:
            page.until_text("vertices")
            page.change("Motion", page.options("Motion")[1])
            page.until_text("no motion")
            for text in page.markdown():
                shown = text.removeprefix("| | |\n|---|---|\n").replace("&nbsp;", "").replace("  \n", "")
                assert not re.search(r"[{}<>\[\]()\x1b#]", re.sub(r"&#\d+;", "", shown)), text
            assert any("&#123;alert&#40;1&#41;&#125;" in text for text in page.markdown())
            for label in ("Motion", "Joint"):
                options = page.options(label)
                assert all(option.isprintable() and len(option) <= 80 for option in options)
                assert any("alert(1)" in option for option in options)
    finally:
        server.stop()


def test_what_one_changes_all_see(server):
    with Page(server) as one, Page(server) as other:
        other.until_text("vertices")
        other.expect()
        one.change("turn z", 30.0)
        other.until_node("/avatar/plain", "vertices")
        assert server.state.posed.pose[1] == pytest.approx([0, 0, np.pi / 6])
        other.expect()
        one.change("turn y", 45.0, number=1)  # of the whole body
        other.until_node("/avatar/plain", "vertices")
        assert server.state.posed.pose[0] == pytest.approx([0, np.pi / 4, 0])
        one.drop()
        other.change("height", 0.5)
        other.until_node("/avatar/plain", "vertices")
        assert server.state.posed.translation[1] == 0.5
        with Page(server) as late:
            late.expect()
            other.change("Reset pose", True)
            late.until_node("/avatar/plain", "vertices")
            assert not server.state.posed.pose.any()


@pytest.fixture
def clock(monkeypatch):
    """The time of the viewers made from now on, seconds; it stands still unless the test changes `now`."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(server_module, "ViewerState", partial(ViewerState, clock=lambda: clock.now))
    return clock


def test_a_motion_plays_and_the_sliders_follow_when_it_is_held(clock, server):
    with Page(server) as page:
        page.change("Motion", "bend")
        page.until(lambda message: message.get("updates", {}).get("label") == "Pause")
        clock.now = 1.5 / 20  # in the middle of frame 1
        page.until_node("/avatar/plain", "vertices")
        frame = page.uuid("Frame")
        page.until(lambda message: message.get("uuid") == frame and message["updates"].get("value") == 1)
        page.change("Pause", True)
        page.until(lambda message: message.get("updates", {}).get("label") == "Play")
        turn = page.uuid("turn z")
        page.until(lambda message: message.get("uuid") == turn and message["updates"]["value"] == pytest.approx(17.2))
        page.change("Frame", 0)
        page.until(lambda message: message.get("uuid") == turn and message["updates"]["value"] == 0)
        page.change("Frame", 3)
        page.until(lambda message: message.get("uuid") == turn and message["updates"]["value"] == pytest.approx(51.6))
        assert server.state.posed.pose[1, 2] == pytest.approx(0.9)  # not that of the slider's whole tenths
        page.change("Motion", "broken")
        page.until_text("no such motion")
        page.change("Motion", "none")
        page.change("turn z", 10.0)
        page.until_node("/avatar/plain", "vertices")


def test_a_slider_changes_one_angle_of_a_pose_that_plays(server):
    with Page(server) as page:
        page.until_text("vertices")
        page.expect()
        with server.state._lock:  # no picture before it plays, so the sliders stay at zero
            server.state.load_motion(load_motion("still")[0])
            server.state.play()
        page.until(lambda message: message.get("updates", {}).get("label") == "Pause")
        page.change("turn x", 10.0)
        turn = page.uuid("turn z")
        page.until(lambda message: message.get("uuid") == turn and message["updates"]["value"] == pytest.approx(51.6))
        assert angles_of(server.state.posed.pose[1]) == pytest.approx((10, 0, np.degrees(0.9)))


def test_the_sliders_show_a_motion_of_one_frame(server):
    with Page(server) as page:
        page.until_text("vertices")
        page.change("Motion", "pose")
        turn = page.uuid("turn z")
        page.until(lambda message: message.get("uuid") == turn and message["updates"]["value"] == pytest.approx(51.6))
        assert not server.state.player.is_playing


def test_every_look(server):
    with Page(server) as page:
        page.until_text("vertices")
        page.change("Weights in colour", True)
        page.until(lambda message: message["type"] == "GlbMessage")
        page.change("turn z", 20.0)
        page.until(lambda message: message["type"] == "GlbMessage")  # the other one: they take turns
        page.change("Canonical shape beside it", True)
        page.until(lambda message: message["type"] == "GlbMessage" and message["name"].startswith("/canonical"))
        page.change("Weights in colour", False)
        page.until(lambda message: message.get("name") == "/canonical/plain")
        page.change("Handle at the joint", True)
        page.until(lambda message: message["type"] == "TransformControlsMessage")
        page.change("Wireframe", True)
        page.until_node("/avatar/plain", "wireframe")
        page.change("Surface", "field")
        page.until_text("surface in")
        page.change("Surface", "skinned")
        page.until_text("skinned")


def test_a_click_chooses_a_joint_and_the_handle_turns_it():
    server = ViewServer(ToyAvatar(3), SMALL)
    try:
        with Page(server) as page:
            page.change("Skeleton", True)
            page.until(lambda message: message["type"] == "TransformControlsMessage")
            server.controls.pose.choose_joint(2)
            assert server.controls.pose.joint == server.scene.chosen_joint == 2
            server.controls.pose.choose_joint(0)  # the root has its own sliders
            assert server.controls.pose.joint == 2
            server.controls.pose.choose_joint(1)
            quarter = np.sqrt(0.5)
            page.expect()
            server.scene.turn_chosen(np.array([quarter, 0, 0, quarter]), is_over=True, client_id=0)
            page.until_node("/avatar/plain", "vertices")
            assert server.state.posed.pose[1] == pytest.approx([0, 0, np.pi / 2])
    finally:
        server.stop()


def test_who_leaves_lets_go_of_the_handle(server, monkeypatch):
    left = queue.Queue()
    monkeypatch.setattr(server.scene, "let_go", left.put)
    with Page(server):
        (client_id,) = server.server.get_clients()
    assert left.get(timeout=PATIENCE_S) == client_id


def test_an_avatar_without_weights_has_no_choice_of_surface():
    avatar = ToyAvatar()
    avatar.model.has_skinning_weights = False
    server = ViewServer(avatar, SMALL)
    try:
        with Page(server) as page:
            page.until_text("surface in")
            inputs = [message["props"] for message in page.messages if "label" in message.get("props", {})]
            shown = {props["label"]: props for props in inputs}
            assert not shown["Weights in colour"]["visible"]
            assert not shown["Canonical shape beside it"]["visible"]
            assert shown["Surface"]["options"] == ["field"]
    finally:
        server.stop()


def test_a_skeleton_of_one_joint_turns_as_a_whole():
    server = ViewServer(OneJoint(), replace(SMALL, shows_skeleton=True))
    try:
        with Page(server) as page:
            page.until_text("vertices")
            folders = [message["props"] for message in page.messages if message["type"] == "GuiFolderMessage"]
            assert {props["label"]: props["visible"] for props in folders} == {"Joint": False, "Whole body": True}
            page.change("turn z", 90.0, number=1)
            page.until_node("/avatar/plain", "vertices")
            assert server.state.posed.pose == pytest.approx(np.array([[0, 0, np.pi / 2]]))
    finally:
        server.stop()


def test_a_port_in_use_names_the_next_one(server):
    with pytest.raises(UserError, match=rf"port: wanted a free one, got {server.port}, which is in use; give --port \d+"):
        check_port("127.0.0.1", server.port)
    with pytest.raises(UserError, match="is in use"):
        ViewServer(ToyAvatar(), SMALL, port=server.port)
    check_port("127.0.0.1", 0)
    with pytest.raises(UserError, match=r"host: wanted an address of this machine, got 203.0.113.7"):  # RFC 5737: of no machine
        check_port("203.0.113.7", 8080)


def test_a_stopped_server_leaves_its_port():
    server = ViewServer(ToyAvatar(), SMALL)
    server.stop()
    server.wait()
    check_port("127.0.0.1", server.port)
    with socket.socket() as client:
        assert client.connect_ex(("127.0.0.1", server.port)) != 0


@pytest.mark.parametrize(
    ("environment", "platform", "can"),
    [
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({}, "linux", False),
        ({}, "darwin", True),
        ({}, "win32", True),
        ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "1.2.3.4 5 6.7.8.9 22"}, "linux", False),
        ({"SSH_TTY": "/dev/pts/0"}, "darwin", False),
    ],
)
def test_a_browser_is_opened_only_where_it_is_seen(environment, platform, can):
    assert can_open_browser(environment, platform) is can
