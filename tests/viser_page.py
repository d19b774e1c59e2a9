"""A client of viser's server for the tests: it reads messages and changes inputs, as the browser does."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
import zstandard
from typing_extensions import Self
from viser import _messages
from websockets.sync.client import ClientConnection, connect

from snarfcli.viewer.server import ViewServer

__all__ = ["Client", "Page", "open_socket"]

PATIENCE_S = 300  # only a broken test waits that long, however busy the machine is


def open_socket(port: int, headers: dict[str, str] | None = None, **changes: Any) -> ClientConnection:
    """Return a connection as the page opens it: with its own origin and the version of viser."""
    options: dict[str, Any] = {"origin": f"http://127.0.0.1:{port}", "subprotocols": [f"viser-v{viser.__version__}"], **changes}
    return connect(f"ws://127.0.0.1:{port}", additional_headers=headers, max_size=None, open_timeout=PATIENCE_S, **options)


class Client:
    """One client of a viewer at a port of this machine.

    Args:
        port: port of the viewer.
        headers: further headers of the handshake.
    """

    def __init__(self, port: int, headers: dict[str, str] | None = None) -> None:
        self._socket = open_socket(port, headers)
        self.messages: list[dict[str, Any]] = []
        self._mark = 0
        self._send(_messages.ViewerCameraMessage((1, 0, 0, 0), (0, 0, 3), 0.8, 0.1, 100, 480, 640, (0, 0, 0), (0, 1, 0)))
        self.until(lambda message: message["type"] == "ReplayDoneMessage")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._socket.close()

    def drop(self) -> None:
        """Drop the connection without closing it properly."""
        self._socket.socket.close()

    def until(self, is_it: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """Wait for a message that satisfies `is_it`; return the first one since the last change from here."""
        seen, deadline = self._mark, time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            for message in self.messages[seen:]:
                if is_it(message):
                    return message
            seen = len(self.messages)
            data = self._socket.recv(timeout=PATIENCE_S)
            length = int.from_bytes(data[8:16], "little")
            self.messages += msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + length]))["messages"]
        raise TimeoutError(f"no such message came within {PATIENCE_S} s")

    def expect(self) -> None:
        """Ignore the messages so far: `until` waits for later ones."""
        self._mark = len(self.messages)

    def until_node(self, name: str, prop: str) -> dict[str, Any]:
        """Wait until a property of a scene node changes."""
        kind = "SceneNodeUpdateMessage"
        return self.until(lambda m: m["type"] == kind and m["name"] == name and prop in m["updates"])

    def until_text(self, part: str) -> None:
        """Wait until a text on the panel contains this part."""
        self.until(lambda message: part in str(message.get("updates", {}).get("_markdown", "")))

    def uuid(self, label: str, number: int = 0) -> str:
        """Return viser's identifier of the input with this label, the `number`th one on the panel."""
        found = [message for message in self.messages if label in _labels(message)]
        return found[number]["uuid"]

    def options(self, label: str) -> list[str]:
        """Return the options of the dropdown with this label."""
        return next(
            message["props"]["options"]
            for message in self.messages
            if label in _labels(message) and "options" in message["props"]
        )

    def markdown(self) -> list[str]:
        """Return all Markdown that has come."""
        parts = (message.get(part, {}) for message in self.messages for part in ("props", "updates"))
        return [part["_markdown"] for part in parts if "_markdown" in part]

    def change(self, label: str, value: Any, number: int = 0) -> None:
        """Change an input, or press a button, as a user of the page would."""
        self.expect()
        self._send(_messages.GuiUpdateMessage(self.uuid(label, number), {"value": value}))

    def send(self, message: dict[str, Any]) -> None:
        """Send any message."""
        self.send_bytes(msgspec.msgpack.encode(message))

    def send_bytes(self, data: bytes | str) -> None:
        """Send any data, text as a message of text."""
        self._socket.send(data)

    def _send(self, message: _messages.Message) -> None:
        self.send(message.as_serializable_dict([]))


class Page(Client):
    """A client of a viewer in this process, which listens to it from the beginning."""

    def __init__(self, server: ViewServer, headers: dict[str, str] | None = None) -> None:
        known, came = set(server.server.get_clients()), queue.Queue()
        server.server.on_client_connect(lambda client: came.put(client.client_id))
        super().__init__(server.port, headers)
        while came.get(timeout=PATIENCE_S) in known:  # before that the server does not listen
            pass


def _labels(message: dict[str, Any]) -> set[str]:
    """Return the labels of inputs in a message."""
    return {part.get("label") for part in (message.get("props", {}), message.get("updates", {}))} - {None}
