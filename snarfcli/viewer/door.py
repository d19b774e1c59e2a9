"""The door of viser's server: checks on connections and messages that viser itself does not make.

DESIGN. viser serves the page and its WebSocket with one call of `websockets.asyncio.server.serve`, and has no settings for it.
So that call is replaced while viser's server is made. Whether the replacement took effect is tested on the running server: with
a version of viser that makes the call differently, nothing is shown, instead of being shown to every web page.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import http
import http.client
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

from snarfcli.errors import UserError
from snarfcli.texts import one_line
from snarfcli.viewer.access import PAGE_HEADERS, Access, Request
from snarfcli.viewer.gate import Gate

__all__ = ["MAX_CLIENTS", "Door"]

MAX_CLIENTS = 16
"""Clients at the same time; more are refused until one leaves."""

_LARGEST_MESSAGE = 16384  # bytes; the page sends at most 400
_PER_SECOND, _BURST = 120.0, 240.0  # messages of one client; a page sends up to 50 camera positions and 20 values per second
_TRY_AGAIN = 1013  # WebSocket close code (IANA registry)
_PATIENCE_S = 20.0
_REPLACING = threading.Lock()

_FOREIGN = "http://foreign.invalid"
_KEY = "dGhlIHNhbXBsZSBub25jZQ=="  # any 16 bytes (RFC 6455, section 1.3)


class Door:
    """Lets in the clients that `access` accepts, a limited number of them, and the messages that `gate` admits.

    Args:
        access: rules for connections.
        gate: rules for messages.
        left: called when a client has left.
    """

    def __init__(self, access: Access, gate: Gate, left: Callable[[], None]) -> None:
        self._access = access
        self._gate = gate
        self._left = left
        self._clients = 0
        # Of its own and silent, since websockets logs each refused or broken handshake as an error with its trace.
        self._log = logging.getLogger(f"{__name__}.connections")
        self._log.setLevel(logging.CRITICAL + 1)

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Put the checks into the server that viser makes meanwhile."""
        import websockets.asyncio.server as module

        with _REPLACING:
            serve = module.serve
            module.serve = functools.partial(self._serve, serve)  # type: ignore[assignment]
            try:
                yield
            finally:
                module.serve = serve

    def verify(self, host: str, port: int) -> None:
        """Try what must be refused, on the running server.

        Raises:
            UserError: it was not refused.
        """
        import viser

        own = f"{host}:{port}"
        attempts = [{"Host": own, "Origin": _FOREIGN}, {"Host": "foreign.invalid", "Origin": "http://foreign.invalid"}]
        if self._access.token is not None:
            attempts = [{"Host": own, "Origin": f"http://{own}"}, {"Host": own}]
        try:
            answers = [_status(host, port, headers) for headers in attempts]
        except (OSError, http.client.HTTPException) as error:
            raise UserError(f"viewer: could not test its protection ({one_line(error, 200)}); try again") from None
        if any(answer != http.HTTPStatus.FORBIDDEN for answer in answers):
            raise UserError(
                f"viewer: wanted a version of viser whose connections can be checked, got {viser.__version__}, which accepts "
                "those of foreign web pages; install another version, for example pip install 'viser==1.1.1'"
            )

    # ---------------------------------------------------------------- in viser's thread
    def _serve(self, serve: Callable[..., Any], handler: Callable[[Any], Awaitable[None]], *places: Any, **options: Any) -> Any:
        """Call `serve` of websockets with the checks around the handlers of viser."""
        options["process_request"] = functools.partial(self._answer, options.get("process_request"))
        options.update(max_size=_LARGEST_MESSAGE, logger=self._log)
        return serve(functools.partial(self._handle, handler), *places, **options)

    def _answer(self, answer: Callable[[Any, Any], Any] | None, connection: Any, request: Any) -> Any:
        """Answer a request: refuse it, redirect it, serve the page, or return None to begin a WebSocket."""
        headers, port = request.headers, connection.local_address[1]
        asked = Request(request.path, port, *(headers.get_all(name) for name in ("Host", "Origin", "Cookie")))
        reason = self._access.refusal(asked)
        if reason is not None:
            return self._refuse(connection, reason)
        if "?" in request.path:
            return self._redirect(connection, port)
        page = None if answer is None else answer(connection, request)
        if page is not None:
            for name, value in PAGE_HEADERS.items():
                page.headers[name] = value
            return page
        if not asked.origins:
            return self._refuse(connection, "wanted the origin of the page")
        return None if _is_viser(headers) else self._refuse(connection, "wanted viser's protocol")

    def _redirect(self, connection: Any, port: int) -> Any:
        """Lead to the page without parameters: the token moves to the cookie, and viser has one that names another server."""
        response = connection.respond(http.HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = "/"
        cookie = self._access.cookie(port)
        if cookie is not None:
            response.headers["Set-Cookie"] = cookie
        return response

    def _refuse(self, connection: Any, reason: str) -> Any:
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"snarf view: {reason}\n")

    async def _handle(self, handle: Callable[[Any], Awaitable[None]], connection: Any) -> None:
        """Run a connection with viser's handler."""
        if self._clients >= MAX_CLIENTS:
            await connection.close(_TRY_AGAIN, f"{MAX_CLIENTS} clients are connected; try again later")
            return
        self._clients += 1
        connection.recv = functools.partial(self._receive, connection.recv, _Pace())
        try:
            await handle(connection)
        finally:
            self._clients -= 1
            self._left()

    async def _receive(self, receive: Callable[[], Awaitable[Any]], pace: _Pace) -> Any:
        """Return the next message that the gate admits. While the viewer is busy, the client waits: nothing is queued."""
        while True:
            message = await receive()
            await pace.wait()
            while self._gate.is_busy:
                await asyncio.sleep(0.02)
            if isinstance(message, bytes) and self._gate.admits(message):
                return message


class _Pace:
    """Limits the messages of one client per second."""

    def __init__(self) -> None:
        self._due = 0.0  # time at which all messages so far would have come at the limit

    async def wait(self) -> None:
        now = time.monotonic()
        self._due = max(self._due, now - _BURST / _PER_SECOND) + 1 / _PER_SECOND
        if self._due > now:
            await asyncio.sleep(self._due - now)


def _is_viser(headers: Any) -> bool:
    """Return whether a handshake is that of the page of the installed viser, which would print a line for any other."""
    import viser

    offered = ",".join(headers.get_all("Sec-WebSocket-Protocol")).split(",")
    return f"viser-v{viser.__version__}" in [protocol.strip() for protocol in offered]


def _status(host: str, port: int, headers: dict[str, str]) -> int:
    """Return the status of the answer to a handshake of a WebSocket with these headers."""
    import viser

    connection = http.client.HTTPConnection(host, port, timeout=_PATIENCE_S)
    try:
        handshake = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": _KEY}
        protocol = {"Sec-WebSocket-Protocol": f"viser-v{viser.__version__}"}
        connection.request("GET", "/", headers={**handshake, **protocol, **headers})
        return connection.getresponse().status
    finally:
        connection.close()
