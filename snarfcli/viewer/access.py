"""Who may open the page and its WebSocket: by the address in the request, its origin, and a token.

DESIGN. A browser lets every web page send requests to any address, and open WebSockets to it; it tells where the page comes
from (Origin) and which address it was asked for (Host). On loopback the address must be a name of this machine: a foreign name
that resolves to it (DNS rebinding) is refused, and so are foreign origins. All other addresses need a token, given once in the
URL and then kept as a cookie that scripts and foreign pages cannot use.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

__all__ = ["PAGE_HEADERS", "Access", "Request", "is_loopback"]

# viser compiles Markdown in the browser, which needs unsafe-eval, and has its script and style in the page. `connect-src` keeps
# the page from connecting to another server, and `frame-ancestors` other pages from showing it in a frame.
PAGE_HEADERS = {
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; connect-src 'self' blob: data:; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of the page that limit what a browser does with it."""

_LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")
_TOKEN_BYTES = 24


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached from this machine only."""
    import ipaddress

    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Request:
    """What matters of a request."""

    path: str
    """Path with query."""
    port: int
    """Port of this machine at which it came in."""
    hosts: Sequence[str]
    """Values of the header Host."""
    origins: Sequence[str]
    cookies: Sequence[str]

    def token(self, name: str) -> str:
        """Return the token in the query, otherwise in the cookie with this name; empty if there is none."""
        given = parse_qs(urlsplit(self.path).query).get("token", [])
        cookies = [part.strip().partition("=") for text in self.cookies for part in text.split(";")]
        given += [value for key, _, value in cookies if key == name]
        return given[0] if given else ""


class Access:
    """The rules for one address.

    Args:
        host: address that the server listens at.
    """

    def __init__(self, host: str) -> None:
        self._host = host
        self.token: str | None = None if is_loopback(host) else secrets.token_urlsafe(_TOKEN_BYTES)
        """Must be given by all clients; None on loopback, where every program of this machine may open the page."""

    @property
    def reachable(self) -> str:
        """Address at which this machine reaches the server, also if it listens at all addresses."""
        return {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}.get(self._host, self._host)

    def address(self, port: int) -> str:
        """Return the address of the page, with the token if one is needed."""
        name = f"[{self.reachable}]" if ":" in self.reachable else self.reachable
        return f"http://{name}:{port}" + (f"/?token={self.token}" if self.token else "")

    def refusal(self, request: Request) -> str | None:
        """Return why a request is refused, None if it is accepted."""
        if len(request.hosts) != 1 or not self._is_own(request.hosts[0].lower(), request.port):
            return "wanted the address that snarf view printed"
        if any(not self.is_own_origin(origin, request) for origin in request.origins):
            return "requests of other pages are refused"
        if self.token is None:
            return None
        given = request.token(self.cookie_name(request.port)).encode(errors="replace")
        is_right = secrets.compare_digest(given, self.token.encode())  # in constant time
        return None if is_right else "wanted the address that snarf view printed, with its token"

    def is_own_origin(self, origin: str, request: Request) -> bool:
        """Return whether an origin is that of the page which the request asks for."""
        host = request.hosts[0].lower()
        return origin.lower() in (f"http://{host}", f"https://{host}")  # https: by a proxy in front

    def cookie_name(self, port: int) -> str:
        """Return the name of the cookie: browsers send the cookies of one port to all ports of a machine."""
        return f"snarf-view-{port}"

    def cookie(self, port: int) -> str | None:
        """Return the header Set-Cookie for a client with the token; None where no token is needed."""
        return f"{self.cookie_name(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict" if self.token else None

    def _is_own(self, host: str, port: int) -> bool:
        if self.token is not None:
            return host != ""  # any name of this machine, known to who has the token
        own = f"[{self._host}]" if ":" in self._host else self._host
        names = {*_LOCAL_NAMES, own.lower()}
        return host in {f"{name}:{port}" for name in names} or (port == 80 and host in names)
