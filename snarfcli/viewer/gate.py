"""What clients of the page may send: only messages that the page could send with the inputs that it has.

viser sets any attribute of an input to any value that a message names, before a callback sees it, and has messages that the
viewer does not use, such as one that opens a tunnel to the internet. So messages are checked before they reach viser.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from snarfcli.texts import one_line

__all__ = ["Check", "Gate", "is_number", "is_vector"]

log = logging.getLogger(__name__)

_LARGEST = 1e9  # of any number
_LARGEST_PICTURE = 65536  # pixels along one side
_UNIT = (0.9, 1.1)  # norm of a quaternion, which browsers send in single precision
_MODIFIERS = {"cmd/ctrl", "alt", "shift"}
_BUSY = 16  # reactions at the same time; viser has 32 threads for them

Check = Callable[[Any], bool]


def is_number(value: object, low: float = -_LARGEST, high: float = _LARGEST) -> bool:
    """Return whether a value is a finite number within limits."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def is_vector(value: object, length: int) -> bool:
    """Return whether a value is a list of so many finite numbers."""
    return isinstance(value, list) and len(value) == length and all(is_number(number) for number in value)


@dataclass(frozen=True)
class _Input:
    """An input of the page."""

    accepts: Check
    """Returns whether the input offers a value now."""
    show_again: Callable[[], None]
    """Called when a value was refused, to show the true one on the page that sent it."""


class Gate:
    """Decides which messages of clients reach viser, and knows how many of them are being reacted to."""

    def __init__(self) -> None:
        import msgspec

        self._decoder = msgspec.msgpack.Decoder(dict[str, Any])
        self._inputs: dict[str, _Input] = {}
        self._clickable: dict[str, int] = {}  # number of instances of scene nodes
        self._handles: set[str] = set()
        self._lock = threading.Lock()
        self._reactions = 0
        self._has_reported = False
        target: dict[str, Check] = {"name": lambda value: _is_text(value) and value in self._handles, "owner": _is_everyones}
        self._fields: dict[str, Mapping[str, Check]] = {
            "GuiUpdateMessage": {"uuid": _is_text, "updates": _is_value},
            "TransformControlsDragStartMessage": target,
            "TransformControlsUpdateMessage": {**target, "wxyz": _is_rotation, "position": _is_place},
            "TransformControlsDragEndMessage": target,
            "SceneNodeClickMessage": {
                "name": lambda value: _is_text(value) and value in self._clickable,
                "owner": _is_everyones,
                "instance_index": lambda value: is_number(value, 0) and isinstance(value, int),
                "ray_origin": _is_place,
                "ray_direction": _is_place,
                "screen_pos": lambda value: is_vector(value, 2),
                "modifier": _is_modifier,
            },
            "ViewerCameraMessage": {
                "wxyz": _is_rotation,
                "position": _is_place,
                "look_at": _is_place,
                "up_direction": _is_place,
                "fov": lambda value: is_number(value, 1e-3, 3.2),
                "near": lambda value: is_number(value, 0),
                "far": lambda value: is_number(value, 0),
                "image_height": lambda value: is_number(value, 0, _LARGEST_PICTURE),
                "image_width": lambda value: is_number(value, 0, _LARGEST_PICTURE),
            },
        }

    # ---------------------------------------------------------------- what the page offers
    def add_input(self, uuid: str, accepts: Check, show_again: Callable[[], None]) -> None:
        """Let clients change an input, known to viser as `uuid`, to values that `accepts` allows."""
        self._inputs[uuid] = _Input(accepts, show_again)

    def add_clickable(self, name: str, count: int) -> None:
        """Let clients click the `count` instances of a scene node."""
        self._clickable[name] = count

    def add_handle(self, name: str) -> None:
        """Let clients drag a transform control."""
        self._handles.add(name)

    # ---------------------------------------------------------------- messages
    def admits(self, data: object) -> bool:
        """Return whether a message may reach viser; never raises."""
        try:
            message = self._decoder.decode(data)  # type: ignore[arg-type]
        except (ValueError, TypeError, RecursionError):
            return self._refuse("a message that is not of viser's format")
        kind = message.pop("type", None)
        fields = self._fields.get(kind) if isinstance(kind, str) else None
        if fields is None:
            return self._refuse(f"a message of the kind {one_line(str(kind), 60)}")
        if message.keys() != fields.keys() or not all(check(message[name]) for name, check in fields.items()):
            return self._refuse(f"{kind} with wrong content")
        if kind == "SceneNodeClickMessage":
            return message["instance_index"] < self._clickable[message["name"]]
        return kind != "GuiUpdateMessage" or self._admits_value(message["uuid"], message["updates"]["value"])

    def _admits_value(self, uuid: str, value: object) -> bool:
        chosen = self._inputs.get(uuid)
        if chosen is None:
            return self._refuse("a value for no input")
        if chosen.accepts(value):
            return True
        chosen.show_again()
        return self._refuse(f"a value that the page does not offer: {one_line(repr(value)[:200], 60)}")

    def _refuse(self, what: str) -> bool:
        """Report the first refused message only, so that a client cannot fill the terminal."""
        if not self._has_reported:
            self._has_reported = True
            log.warning("a client of the page sent %s; ignored, as others will be silently", what)
        return False

    # ---------------------------------------------------------------- reactions
    @property
    def is_busy(self) -> bool:
        """Whether so many messages are being reacted to that further ones must wait."""
        return self._reactions >= _BUSY

    def reaction(self, react: Callable[[Any], Any]) -> Callable[[Any], None]:
        """Return `react` as a callback for viser, which would print a trace for each exception."""

        def reacted(event: Any) -> None:
            with self._counted():
                try:
                    react(event)
                except Exception as error:
                    log.error("the viewer continues after: %s: %s", type(error).__name__, one_line(error, 300))

        return reacted

    @contextlib.contextmanager
    def _counted(self) -> Iterator[None]:
        with self._lock:
            self._reactions += 1
        try:
            yield
        finally:
            with self._lock:
                self._reactions -= 1


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_place(value: object) -> bool:
    return is_vector(value, 3)


def _is_everyones(value: object) -> bool:
    """Return whether a node belongs to all clients, as all of the viewer do."""
    return value == ""


def _is_value(value: object) -> bool:
    return isinstance(value, dict) and value.keys() == {"value"}


def _is_rotation(value: Any) -> bool:
    return is_vector(value, 4) and _UNIT[0] <= sum(number**2 for number in value) ** 0.5 <= _UNIT[1]


def _is_modifier(value: object) -> bool:
    return value is None or (isinstance(value, str) and set(value.split("+")) <= _MODIFIERS)
