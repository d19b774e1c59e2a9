"""A page in headless Chromium, driven through its DevTools protocol: scripts, what the console says, requests, pictures.

Source: https://chromedevtools.github.io/devtools-protocol (domains Runtime, Log, Network, Page and Emulation).
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

__all__ = ["CHROMIUM", "Page", "needs_chromium", "opened"]

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="wants Chromium")

_WAIT_S = 120.0  # for pages drawn without a graphics card on a busy machine


class Page:
    """One page; messages of the browser are collected while it is asked."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._number = 0
        self.complaints: list[str] = []
        """Errors and warnings of the console, exceptions, and what the Content-Security-Policy has blocked."""
        self.requests: list[str] = []
        """Addresses that the page has asked for."""

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=_WAIT_S))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self._note(message.get("method"), message.get("params", {}))

    def _note(self, method: str | None, event: dict[str, Any]) -> None:
        if method == "Runtime.consoleAPICalled" and event["type"] in ("error", "warning", "assert"):
            self.complaints.append(str([argument.get("value", argument.get("description")) for argument in event["args"]]))
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(event["exceptionDetails"]))
        elif method == "Log.entryAdded" and event["entry"]["level"] in ("error", "warning"):
            self.complaints.append(event["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(event["request"]["url"])

    def run(self, script: str) -> Any:
        """Return the value of an expression of JavaScript, waiting for a promise."""
        done = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + _WAIT_S
        while not self.run(condition):
            assert time.monotonic() < end, f"{condition} does not come true; {self.complaints}"
            time.sleep(0.05)

    def picture(self) -> bytes:
        """Return what the page shows, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


@contextmanager
def opened(address: str, profile: Path, width: int = 960, height: int = 640) -> Iterator[Page]:
    """Open an address in a browser of its own.

    Args:
        address: such as file:///page.html.
        profile: an empty folder for the browser.
        width, height: of the page, pixels.
    """
    client = pytest.importorskip("websockets.sync.client", reason="wants the package websockets")
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", f"--user-data-dir={profile}", "--no-first-run", "--disable-extensions",
        "--disable-background-networking", "--disable-component-update", "--disable-sync", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "about:blank",
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
        try:
            with client.connect(_page_address(profile), max_size=None, proxy=None) as socket:
                page = Page(socket)
                for domain in ("Runtime", "Log", "Network", "Page"):
                    page.call(f"{domain}.enable")
                page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
                page.call("Page.navigate", url=address)
                page.wait("location.href !== 'about:blank' && document.readyState === 'complete'")
                yield page
        finally:
            browser.kill()


def _page_address(profile: Path) -> str:
    """Return the address at which the first page of a started browser listens."""
    import urllib.request

    port, end = profile / "DevToolsActivePort", time.monotonic() + _WAIT_S
    open_directly = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
    while True:
        assert time.monotonic() < end, "Chromium does not start"
        lines = port.read_text().splitlines() if port.exists() else []
        if len(lines) == 2:
            with open_directly(f"http://127.0.0.1:{lines[0]}/json/list") as answer:
                pages = [target for target in json.load(answer) if target["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.05)
