"""The browser's side of viser's connection, as far as the tests need it: it reads messages and changes inputs."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
import zstandard
from viser import _messages
from websockets.sync.client import connect

__all__ = ["Page"]

PATIENCE = 10  # seconds; nothing waits that long unless something is wrong


class Page:
    """One client of viser's server on this machine."""

    def __init__(self, server: viser.ViserServer) -> None:
        port, known, came = server.get_port(), set(server.get_clients()), queue.Queue()
        server.on_client_connect(lambda client: came.put(client.client_id))
        self._socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None, open_timeout=PATIENCE
        )
        self.messages: list[dict[str, Any]] = []
        self._mark = 0
        self._send(_messages.ViewerCameraMessage((1, 0, 0, 0), (0, 0, 3), 0.8, 0.1, 100, 480, 640, (0, 0, 0), (0, 1, 0)))
        self.until(lambda message: message["type"] == "ReplayDoneMessage")
        while came.get(timeout=PATIENCE) in known:  # before that the server does not listen
            pass

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *error: Any) -> None:
        self._socket.close()

    def drop(self) -> None:
        """Be gone without a word."""
        self._socket.socket.close()

    def until(self, is_it: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """Return a message that is what is waited for, the first one since the last change from here; wait for it."""
        seen, deadline = self._mark, time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for message in self.messages[seen:]:
                if is_it(message):
                    return message
            seen = len(self.messages)
            data = self._socket.recv(timeout=PATIENCE)
            length = int.from_bytes(data[8:16], "little")
            self.messages += msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + length]))["messages"]
        raise TimeoutError("no such message came")

    def expect(self) -> None:
        """Wait from now on for messages that are new."""
        self._mark = len(self.messages)

    def until_node(self, name: str, prop: str) -> dict[str, Any]:
        """Wait until a property of a node of the scene changes."""
        kind = "SceneNodeUpdateMessage"
        return self.until(lambda m: m["type"] == kind and m["name"] == name and prop in m["updates"])

    def until_text(self, part: str) -> None:
        """Wait until a text on the panel has this part."""
        self.until(lambda message: part in str(message.get("updates", {}).get("_markdown", "")))

    def uuid(self, label: str, number: int = 0) -> str:
        """Return viser's name for the input with this label, the `number`th one of the panel."""
        found = [message for message in self.messages if label in _labels(message)]
        return found[number]["uuid"]

    def change(self, label: str, value: Any, number: int = 0) -> None:
        """Change an input as somebody at this page would, or press a button."""
        self.expect()
        self._send(_messages.GuiUpdateMessage(self.uuid(label, number), {"value": value}))

    def _send(self, message: _messages.Message) -> None:
        self._socket.send(msgspec.msgpack.encode(message.as_serializable_dict([])))


def _labels(message: dict[str, Any]) -> set[str]:
    """Return the labels that a message gives to an input."""
    return {part.get("label") for part in (message.get("props", {}), message.get("updates", {}))} - {None}
