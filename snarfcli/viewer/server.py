"""The server of the page: its port, and the thread that updates the page."""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from snarfcli.errors import UserError
from snarfcli.models.trained_field import TrainedField
from snarfcli.viewer.access import Access
from snarfcli.viewer.body import ViewerBody
from snarfcli.viewer.controls import Controls
from snarfcli.viewer.door import Door
from snarfcli.viewer.gate import Gate
from snarfcli.viewer.picture import ViewerLook
from snarfcli.viewer.scene import ViewerScene
from snarfcli.viewer.state import ViewerState

__all__ = ["ViewServer", "can_open_browser", "check_port", "require_viser"]

log = logging.getLogger(__name__)

_TRIED_PORTS = 100
_SHORTEST_S = 1 / 60  # minimum time between two pictures


def require_viser() -> None:
    """Check that viser is installed.

    Raises:
        UserError: it is not; the message says how to install it.
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise UserError(f"viewer: wanted viser, got {error}; pip install 'snarf[view]'") from None


def check_port(host: str, port: int) -> None:
    """Check that a server can listen at a port; 0 stands for any free one.

    Raises:
        UserError: it is in use, or the host is no address of this machine; the message names the next free port.
    """
    reason = _refusal(host, port)
    if reason is None:
        return
    if isinstance(reason, PermissionError):
        raise UserError(f"port: wanted a number above 1023, got {port}, which is reserved for the system; give --port NUMBER")
    if port and not _is_address_fault(host):
        free = next((number for number in range(port + 1, min(port + _TRIED_PORTS, 65536)) if not _refusal(host, number)), 0)
        raise UserError(_in_use(port, f"{free}" if free else "auto"))
    raise UserError(f"host: wanted an address of this machine, got {host} ({reason}); give none, or host=0.0.0.0 for all")


def _in_use(port: int, free: str) -> str:
    """Return the message for a port that is in use, with a free one, or auto."""
    return f"port: wanted a free one, got {port}, which is in use; give --port {free}"


def _refusal(host: str, port: int) -> OSError | None:
    """Return the error of listening at an address, None if it is free."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family, kind) as listener:
            if os.name == "posix":  # a port that was closed a moment ago is free
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(1)
    except OSError as error:
        return error
    return None


def _is_address_fault(host: str) -> bool:
    return _refusal(host, 0) is not None


def can_open_browser(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Return whether a browser opened here is visible to the user: not over SSH, and not without a display."""
    if environment.get("SSH_CONNECTION") or environment.get("SSH_TTY"):
        return False
    return platform in ("win32", "darwin") or bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


class ViewServer:
    """Shows an avatar on a page, from its construction until `stop`.

    Args:
        avatar: avatar to show.
        look: initial look.
        host: address to listen at.
        port: port to listen at; 0 takes any free one.
        motions: names of the motions that can be played.
        load_motion: returns the motion of a name and its bone transforms; raises UserError.
        facts: names and values for the tab about the avatar.
        first_motion: name, motion and bone transforms of the motion that is played at first; None for none.

    Raises:
        UserError: the port is in use, or viser is not installed, or its version cannot be protected.
    """

    def __init__(
        self,
        avatar: TrainedField,
        look: ViewerLook,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        motions: Sequence[str] = (),
        load_motion: Callable[[str], tuple[Any, Any]] | None = None,
        facts: Mapping[str, str] | None = None,
        first_motion: tuple[str, Any, Any] | None = None,
    ) -> None:
        require_viser()
        check_port(host, port)
        import viser

        self._woken = threading.Event()
        self._is_stopped = False
        self._has_garbage = False  # whether a client has left
        self._is_ready = False  # whether there is something to show
        self.state = ViewerState(ViewerBody(avatar), look, self._woken.set)
        self.access, self.gate = Access(host), Gate()
        door = Door(self.access, self.gate, self._count_leaver)
        with _silence(), door.installed():
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.port: int = self.server.get_port()
        if port not in (0, self.port):  # another program was faster, and viser took the next port
            self._stop_server()
            raise UserError(_in_use(port, f"{self.port}"))
        try:
            door.verify(self.access.reachable, self.port)
        except UserError:
            self._stop_server()
            raise
        if first_motion is not None:
            self.state.load_motion(*first_motion[1:])
        self.scene = ViewerScene(self.server, self.gate, self.state, lambda joint: self.controls.pose.choose_joint(joint))
        self.controls = Controls(
            self.server,
            self.gate,
            self.state,
            self.scene,
            motions,
            load_motion or _no_motion,
            facts or {},
            first_motion[0] if first_motion else None,
        )
        if first_motion is not None:
            self.state.play()
        self.server.on_client_connect(lambda client: self._woken.set())
        self.server.on_client_disconnect(lambda client: self._forget_client(client.client_id))
        self._thread = threading.Thread(target=self._run, name="snarf-view", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """The address of the page, with its token if it needs one."""
        return self.access.address(self.port)

    def stop(self) -> None:
        """Stop the server and the threads, which may take as long as the surface that is being computed."""
        self._is_stopped = True
        self._woken.set()
        self._thread.join(timeout=10)
        self.state.stop()
        self._stop_server()

    def _count_leaver(self) -> None:
        self._has_garbage = True
        self._woken.set()

    def _forget_client(self, client_id: int) -> None:
        self.scene.let_go(client_id)
        self._woken.set()

    def _stop_server(self) -> None:
        with _silence():
            self.server.stop()

    def wait(self) -> None:
        """Wait until the page is no longer updated; signals such as Ctrl-C are handled meanwhile."""
        while self._thread.is_alive():
            self._thread.join(timeout=0.5)

    def _run(self) -> None:
        timeout: float | None = 0.0
        while True:
            self._woken.wait(timeout)
            self._woken.clear()
            if self._is_stopped:
                return
            if self._has_garbage:  # viser's objects of a client refer to each other: without this, 0.4 MB of each stay for long
                self._has_garbage = False
                gc.collect()
            start = time.monotonic()
            try:
                waits = self._step()
            except Exception as error:  # a picture that fails must not end the viewer
                log.error("the viewer continues after: %s: %s", type(error).__name__, error, exc_info=error)
                waits = [1.0]
            if self._is_ready and not self.server.get_clients():
                waits = []  # no clients: no need to play
            timeout = min((wait for wait in waits if wait is not None), default=None)
            rest = _SHORTEST_S - (time.monotonic() - start)
            if rest > 0:  # changes made meanwhile go into one picture
                time.sleep(rest)
            timeout = None if timeout is None else max(timeout - max(rest, 0.0), 0.0)

    def _step(self) -> list[float | None]:
        """Show the current picture; return the seconds until each part needs an update."""
        picture, frame_wait = self.state.picture()
        self._is_ready = picture.mesh is not None or picture.message is not None
        self.scene.show(picture)
        return [frame_wait, self.scene.advance(), self.controls.follow(picture)]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Hide the messages of viser on the terminal, which no option turns off."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _no_motion(name: str) -> tuple[Any, Any]:
    raise UserError(f"motion: wanted none, got '{name}'; this viewer has no motions")
