from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snarfcli.viewer.inputs import AngleSliders
from snarfcli.viewer.joints import vector_of


class Slider:
    """Like a slider of viser, set by the program or moved by a client."""

    react: Callable[[float], None]

    def __init__(self, *_: object, **__: object) -> None:
        self.value = 0.0

    def move(self, value: float) -> None:
        self.value = value
        self.react(value)


class PlainInputs:
    """Makes such sliders."""

    add_slider = Slider

    def on_user(self, slider: Slider, react: Callable[[float], None]) -> None:
        slider.react = react


class Joint:
    """A joint that is turned by three sliders."""

    def __init__(self) -> None:
        self.vector = np.zeros(3)
        self.angles = AngleSliders(PlainInputs(), lambda: self.vector, self.turn)

    def turn(self, vector: np.ndarray) -> None:
        self.vector = vector

    @property
    def shown(self) -> list[float]:
        return [slider.value for slider in self.angles.sliders]

    def is_at(self, *angles: float) -> bool:
        turn = Rotation.from_rotvec(vector_of(angles)).inv() * Rotation.from_rotvec(self.vector)
        return turn.magnitude() < 1e-9


def test_one_slider_changes_one_angle_of_the_pose_also_if_the_others_are_outdated():
    joint = Joint()
    joint.vector = vector_of((12.34, -30.0, 56.78))  # by a motion that plays
    assert joint.shown == [0, 0, 0]
    joint.angles.sliders[1].move(45.0)
    assert joint.is_at(12.34, 45, 56.78)
    joint.angles.show(joint.vector)
    assert joint.shown == pytest.approx([12.3, 45, 56.8])
    joint.angles.sliders[0].move(-5.0)
    assert joint.is_at(-5, 45, 56.78)  # not the tenths that the slider shows


def test_angles_stay_as_they_were_chosen_where_others_mean_the_same():
    joint = Joint()
    for number, angle in ((1, 90.0), (0, 20.0), (2, 30.0)):
        joint.angles.sliders[number].move(angle)
        joint.angles.show(joint.vector)
    assert joint.shown == [20, 90, 30]
    joint.angles.sliders[1].move(80.0)
    assert joint.is_at(20, 80, 30)
