"""Who gets into a running viewer, and what clients can do there."""

from __future__ import annotations

import contextlib
import http.client
import queue
import random
import socket

import pytest
from toy_avatar import ToyAvatar
from toy_viewer import PATIENCE_S, SMALL

from snarfcli.errors import UserError
from snarfcli.motions import Motion
from snarfcli.viewer.access import Access
from snarfcli.viewer.door import MAX_CLIENTS, Door
from snarfcli.viewer.gate import Gate
from snarfcli.viewer.inputs import Inputs
from snarfcli.viewer.server import ViewServer

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'snarf[view]'")

from viser_page import Page, open_socket
from websockets.exceptions import ConnectionClosed, InvalidStatus
from wrong_messages import WRONG_VALUES, wrong_bytes, wrong_messages


def load_motion(name: str):
    poses = ToyAvatar().skeleton.canonical_pose.numpy()[None].repeat(4, axis=0).astype(float)
    return Motion(name, poses, poses[:, 0], 20.0), None


@pytest.fixture(scope="module")
def server():
    server = ViewServer(ToyAvatar(), SMALL, motions=["bend"], load_motion=load_motion, facts={"subject": "toy"})
    yield server
    server.stop()


@pytest.fixture(scope="module")
def open_server():
    """A viewer at all addresses of this machine."""
    server = ViewServer(ToyAvatar(), SMALL, host="0.0.0.0")
    yield server
    server.stop()


def get(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """Return the answer to a request with these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", path, headers={name.title(): value for name, value in headers.items()})
    answer = connection.getresponse()
    answer.content = answer.read()
    connection.close()
    return answer


def handshake(port: int, **changes) -> int:
    """Return the status of the answer to a handshake, 101 for a connection."""
    try:
        with open_socket(port, **changes):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_the_page_is_its_own_only(server):
    port = server.port
    page = get(port)
    assert page.status == 200
    assert b"<html" in page.content
    policy = page.headers["Content-Security-Policy"]
    assert "connect-src 'self' blob: data:;" in policy
    assert "frame-ancestors 'none'" in policy
    assert get(port, host=f"localhost:{port}").status == 200
    for wrong in ({"host": f"evil.example:{port}"}, {"host": "127.0.0.1"}, {"origin": "http://evil.example"}):
        answer = get(port, **wrong)
        assert answer.status == 403
        assert b"<html" not in answer.content


def test_parameters_of_viser_that_name_another_server_are_dropped(server):
    for query in ("/?websocket=ws://evil.example", "/?playbackPath=http://evil.example/a.viser", "//evil.example?"):
        answer = get(server.port, query)
        assert answer.status == 303
        assert answer.headers["Location"] == "/"
        assert answer.headers["Set-Cookie"] is None


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", None])
def test_a_foreign_page_gets_no_connection(server, origin):
    assert handshake(server.port) == 101
    assert handshake(server.port, origin=origin) == 403


def test_a_name_that_another_site_lets_point_here_gets_no_connection(server):
    name = f"evil.example:{server.port}"
    for origin in (f"http://{name}", f"http://127.0.0.1:{server.port}"):
        assert handshake(server.port, headers={"Host": name}, origin=origin) == 403
    assert handshake(server.port, subprotocols=["viser-v0.0.0"]) == 403
    assert handshake(server.port, subprotocols=[]) == 403


def test_other_addresses_need_the_token(open_server):
    port, token = open_server.port, open_server.access.token
    assert token
    assert open_server.address == f"http://127.0.0.1:{port}/?token={token}"
    wrong = {"Cookie": f"snarf-view-{port}={token[:-1]}"}
    for refused in (get(port), get(port, f"/?token={token[:-1]}"), get(port, cookie=wrong["Cookie"])):
        assert refused.status == 403
        assert token.encode() not in refused.content
        assert refused.headers["Set-Cookie"] is None
    assert handshake(port) == handshake(port, headers=wrong) == 403

    entry = get(port, f"/?token={token}")
    assert (entry.status, entry.headers["Location"]) == (303, "/")
    cookie, *attributes = entry.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(attributes)
    assert get(port, cookie=cookie).status == 200
    assert get(port, cookie=cookie, origin="http://evil.example").status == 403
    assert handshake(port, headers={"Cookie": cookie}, origin="http://evil.example") == 403
    with Page(open_server, {"Cookie": cookie}) as page:
        page.until_text("vertices")


def test_an_unprotected_server_is_not_shown(monkeypatch):
    monkeypatch.setattr(Door, "installed", lambda door: contextlib.nullcontext())
    for host in ("127.0.0.1", "0.0.0.0"):
        with pytest.raises(UserError, match=r"wanted a version of viser whose connections can be checked, got \d"):
            ViewServer(ToyAvatar(), SMALL, host=host)
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        with pytest.raises(UserError, match="could not test its protection"):
            Door(Access("127.0.0.1"), Gate(), lambda: None).verify("127.0.0.1", nobody.getsockname()[1])


def test_more_clients_than_allowed_are_sent_away_until_one_leaves(server):
    left = queue.Queue()
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_CLIENTS - 1):
            stack.enter_context(Page(server))
        with Page(server):
            for _ in range(3):
                with open_socket(server.port) as refused, pytest.raises(ConnectionClosed) as closed:
                    refused.recv(timeout=PATIENCE_S)
                assert closed.value.rcvd.code == 1013
            server.server.on_client_disconnect(left.put)
        left.get(timeout=PATIENCE_S)
        with Page(server) as late:
            late.until_text("vertices")


def state_of(server: ViewServer) -> tuple:
    """Return what clients could change."""
    state = server.state
    motion = None if state.motion is None else state.motion.name
    posed = state.posed
    return state.look, posed.number, state.player.speed, state.player.is_looping, motion, server.scene.body_color


def test_an_impossible_resolution_is_ignored_and_the_true_one_shown_again(server):
    with Page(server) as page:
        page.until_text("vertices")
        before = state_of(server)
        resolution = page.uuid("Resolution")
        for value in ("3000", 3000, 24.0, None):
            page.change("Resolution", value)
            page.until(lambda message: message.get("uuid") == resolution and message["updates"].get("value") == "24")
        assert state_of(server) == before


def test_wrong_messages_change_nothing_and_end_nothing(server, capfd, caplog):
    """Those of every kind, from one client, which then uses the page as before."""
    source = random.Random(1)
    with Page(server) as page:
        page.until_text("vertices")
        server.scene.shows_handle = True
        before = state_of(server)
        inputs = [message["uuid"] for message in page.messages if "value" in message]
        assert len(inputs) > 15
        messages = list(wrong_messages(inputs, source))
        for message in messages[::8]:
            page.send(message)
        for data in wrong_bytes(source):
            page.send_bytes(data)
        page.send_bytes("text")
        page.change("Motion", "3000")  # the messages of a client are read in order
        motion = page.uuid("Motion")
        page.until(lambda message: message.get("uuid") == motion and message["updates"].get("value") == "none")
        assert state_of(server) == before
        page.change("height", 0.25)
        page.until_node("/avatar/plain", "vertices")
        assert server.state.posed.translation[1] == 0.25
    assert "Traceback" not in "".join(capfd.readouterr()) + caplog.text


def test_a_huge_message_ends_only_the_connection_that_sent_it(server, capfd):
    with Page(server) as page, Page(server) as other:
        page.send_bytes(b"x" * 10**6)
        with pytest.raises(ConnectionClosed):
            page.until(lambda message: False)
        other.until_text("vertices")
    assert "Traceback" not in "".join(capfd.readouterr())


def test_a_value_counts_as_chosen_also_if_the_program_sets_another_meanwhile(server):
    class Event:
        def __init__(self, handle) -> None:
            self.client, self.target = "a client", handle

    chosen = []
    inputs = Inputs(server.server.gui, server.gate)
    slider = inputs.add_slider("test", 0, 9, 1, 5)
    try:
        inputs.on_user(slider, chosen.append)
        assert server.gate._inputs[slider._impl.uuid].accepts(7.0)
        slider.value = 3
        slider._impl.update_cb[-1](Event(slider))
        assert chosen == [7]
    finally:
        slider.remove()
        server.gate._inputs.pop(slider._impl.uuid)


def test_every_input_refuses_what_it_does_not_offer(server):
    handles = server.server.gui._gui_input_handle_from_uuid
    assert len(handles) == len(server.gate._inputs) > 15
    for uuid, handle in handles.items():
        before = handle.value
        for value in WRONG_VALUES:
            assert not server.gate._inputs[uuid].accepts(value), (handle.label, value)
        assert handle.value == before
