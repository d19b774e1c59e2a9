"""Inputs of the panel: changes by users, and three sliders for one rotation."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.viewer.joints import ANGLE_LIMITS_DEG, angles_of, vector_of

__all__ = ["AngleSliders", "on_user", "rounded"]

_AXES = (("x", "to the left"), ("y", "up"), ("z", "to the front"))
_SAME_RAD = 1e-6  # largest difference between a pose and its angles, in double precision


class AngleSliders:
    """Three sliders that rotate a joint about the axes of its parent.

    The sliders are not updated while a motion plays: they show the pose of an earlier frame.

    Args:
        gui: GUI of viser.
        pose_of: pauses the motion and returns the rotation vector [3] of the joint, radians.
        turn: called with the rotation vector that a user chose.
    """

    def __init__(
        self, gui: Any, pose_of: Callable[[], NDArray[np.float64]], turn: Callable[[NDArray[np.float64]], None]
    ) -> None:
        self._pose_of = pose_of
        self._turn = turn
        self._angles = (0.0, 0.0, 0.0)  # degrees, last chosen or shown, not rounded as in the sliders
        self._lock = threading.Lock()  # changes come from several threads
        self.sliders = [
            gui.add_slider(f"turn {axis}", -limit, limit, 0.1, 0.0, hint=f"degrees about the parent's {axis} axis, {way}")
            for (axis, way), limit in zip(_AXES, ANGLE_LIMITS_DEG, strict=True)
        ]
        for number, slider in enumerate(self.sliders):
            on_user(slider, lambda handle, client, number=number: self._change(number))

    def show(self, vector: NDArray[np.float64]) -> None:
        """Set the sliders to a rotation vector [3], radians."""
        self._angles = self._angles_for(vector)
        for slider, angle in zip(self.sliders, self._angles, strict=True):
            slider.value = rounded(angle, 1)

    def _change(self, number: int) -> None:
        """Rotate the joint about the axis of the moved slider; the other two angles stay those of its pose."""
        with self._lock:
            angles = list(self._angles_for(self._pose_of()))
            angles[number] = self.sliders[number].value
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


def on_user(handle: Any, react: Callable[[Any, Any], None]) -> None:
    """Call `react` with the handle and the client when a user changes an input, but not when the program does."""

    def updated(event: Any) -> None:
        if event.client is not None:
            react(event.target, event.client)

    handle.on_update(updated)
