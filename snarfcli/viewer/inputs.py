"""Inputs of the panel, which accept only what they offer, and three sliders for one rotation."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.viewer.gate import Check, Gate, is_number, is_vector
from snarfcli.viewer.joints import ANGLE_LIMITS_DEG, angles_of, vector_of

__all__ = ["AngleSliders", "Inputs", "rounded"]

_AXES = (("x", "to the left"), ("y", "up"), ("z", "to the front"))
_SAME_RAD = 1e-6  # largest difference between a pose and its angles, in double precision


class Inputs:
    """Makes the inputs of the panel. A client can only choose what an input offers, while it is visible and enabled.

    Args:
        gui: GUI of viser.
        gate: told which values the inputs offer; it must see all messages of clients.
    """

    def __init__(self, gui: Any, gate: Gate) -> None:
        self._gui = gui
        self._gate = gate
        self._chosen: dict[str, Any] = {}  # the latest value that a client chose for each input

    def add_dropdown(self, label: str, options: Sequence[str], value: str, **more: Any) -> Any:
        """Add a list of options."""
        handle = self._gui.add_dropdown(label, tuple(options), initial_value=value, **more)
        return self._accept(handle, lambda value: isinstance(value, str) and value in handle.options)

    def add_slider(self, label: str, low: float, high: float, step: float, value: float, **more: Any) -> Any:
        """Add a slider; if all numbers are whole, so are its values."""
        handle = self._gui.add_slider(label, low, high, step, value, **more)
        is_whole = all(isinstance(number, int) for number in (low, high, step, value))
        return self._accept(
            handle,
            lambda value: is_number(value, handle.min, handle.max) and (not is_whole or value == int(value)),
            int if is_whole else float,
        )

    def add_checkbox(self, label: str, value: bool, **more: Any) -> Any:
        """Add a checkbox."""
        return self._accept(self._gui.add_checkbox(label, value, **more), lambda value: isinstance(value, bool))

    def add_rgb(self, label: str, value: tuple[int, int, int], **more: Any) -> Any:
        """Add a choice of a colour, sRGB."""
        handle = self._gui.add_rgb(label, value, **more)
        return self._accept(
            handle,
            lambda value: is_vector(value, 3) and all(0 <= part <= 255 for part in value),
            lambda value: tuple(int(part) for part in value),
        )

    def add_button(self, label: str, react: Callable[[Any], Any], **more: Any) -> Any:
        """Add a button; `react` gets the client."""
        handle = self._accept(self._gui.add_button(label, **more), lambda value: value is True)
        handle.on_click(self._gate.reaction(lambda event: event.client and react(event.client)))
        return handle

    def add_buttons(self, options: Sequence[str], react: Callable[[str], Any], **more: Any) -> Any:
        """Add a row of buttons; `react` gets the pressed one."""
        handle = self._gui.add_button_group("", tuple(options), **more)
        handle.on_click(self._gate.reaction(lambda event: react(self._chosen[handle._impl.uuid])))
        return self._accept(handle, lambda value: isinstance(value, str) and value in handle.options)

    def add_folder(self, label: str, **more: Any) -> Any:
        """Add a folder, a context for the inputs in it."""
        return self._gui.add_folder(label, **more)

    def on_user(self, handle: Any, react: Callable[[Any], Any]) -> None:
        """Call `react` with the value that a user chooses, but not when the program sets it, which may happen meanwhile."""
        handle.on_update(self._gate.reaction(lambda event: event.client and react(self._chosen[handle._impl.uuid])))

    def _accept(self, handle: Any, offers: Check, convert: Callable[[Any], Any] = lambda value: value) -> Any:
        """Let clients set an input to the values that it offers, which `convert` gives their type."""

        def accepts(value: object) -> bool:
            is_offered = handle.visible and not handle.disabled and offers(value)
            if is_offered:
                self._chosen[handle._impl.uuid] = convert(value)
            return is_offered

        def show_again() -> None:
            handle._queue_update("value", handle.value)  # an assignment is not sent where nothing changes

        self._gate.add_input(handle._impl.uuid, accepts, show_again)
        return handle


class AngleSliders:
    """Three sliders that rotate a joint about the axes of its parent.

    The sliders are not updated while a motion plays: they show the pose of an earlier frame.

    Args:
        inputs: makes the sliders.
        pose_of: pauses the motion and returns the rotation vector [3] of the joint, radians.
        turn: called with the rotation vector that a user chose.
    """

    def __init__(
        self, inputs: Inputs, pose_of: Callable[[], NDArray[np.float64]], turn: Callable[[NDArray[np.float64]], None]
    ) -> None:
        self._pose_of = pose_of
        self._turn = turn
        self._angles = (0.0, 0.0, 0.0)  # degrees, last chosen or shown, not rounded as in the sliders
        self._lock = threading.Lock()  # changes come from several threads
        self.sliders = [
            inputs.add_slider(f"turn {axis}", -limit, limit, 0.1, 0.0, hint=f"degrees about the parent's {axis} axis, {way}")
            for (axis, way), limit in zip(_AXES, ANGLE_LIMITS_DEG, strict=True)
        ]
        for number, slider in enumerate(self.sliders):
            inputs.on_user(slider, lambda value, number=number: self._change(number, value))

    def show(self, vector: NDArray[np.float64]) -> None:
        """Set the sliders to a rotation vector [3], radians."""
        self._angles = self._angles_for(vector)
        for slider, angle in zip(self.sliders, self._angles, strict=True):
            slider.value = rounded(angle, 1)

    def _change(self, number: int, angle: float) -> None:
        """Rotate the joint about the axis of the moved slider; the other two angles stay those of its pose."""
        with self._lock:
            angles = list(self._angles_for(self._pose_of()))
            angles[number] = angle
            x, y, z = angles
            self._angles = (x, y, z)
            self._turn(vector_of(self._angles))

    def _angles_for(self, vector: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return the angles of a rotation; the current ones if they are equivalent, since several triples may be."""
        current = Rotation.from_rotvec(vector_of(np.array(self._angles)))
        is_same = (current.inv() * Rotation.from_rotvec(vector)).magnitude() < _SAME_RAD
        return self._angles if is_same else angles_of(vector)


def rounded(number: float, digits: int) -> float:
    """Return a rounded number for a slider, without negative zero."""
    return round(float(number), digits) + 0.0
