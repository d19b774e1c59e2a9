"""The tab of the pose: single joints, and the whole body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from snarfcli.viewer.inputs import AngleSliders, Inputs, rounded
from snarfcli.viewer.joints import joint_labels, pose_file
from snarfcli.viewer.picture import Picture
from snarfcli.viewer.scene import ViewerScene
from snarfcli.viewer.state import ViewerState

__all__ = ["PoseTab"]

_REACH_M = 3.0  # range of the height slider, about twice the height of a person


class PoseTab:
    """The inputs of the pose, added to the current container of viser.

    Args:
        inputs: makes the inputs.
        state: state of the viewer.
        scene: scene of the viewer, which marks the chosen joint.
    """

    def __init__(self, inputs: Inputs, state: ViewerState, scene: ViewerScene) -> None:
        self._inputs = inputs
        self._state = state
        self._scene = scene
        self._labels = joint_labels(state.body.skeleton)
        self._seen_pose = -1  # number of the pose that the sliders show
        with inputs.add_folder("Joint", visible=bool(self._labels)):  # a skeleton of one joint has its root only
            joints = tuple(self._labels) or ("none",)
            self._joint = inputs.add_dropdown("Joint", joints, joints[0], hint="or click one in the picture (Look: skeleton)")
            self._angles = self._add_angles(lambda: self.joint)
            inputs.add_buttons(("Straight", "Mirror"), self._press, hint="mirror: rotate the opposite joint alike")
        with inputs.add_folder("Whole body"):
            self._turns = self._add_angles(lambda: 0)
            self._height = inputs.add_slider("height", -_REACH_M, _REACH_M, 0.01, 0.0, hint="metres above its place at rest")
        inputs.add_button("Reset pose", lambda client: state.reset_pose(), icon="refresh")
        inputs.add_button("Save pose", self._save, icon="download", hint="as .npz, which --pose reads again")
        inputs.on_user(self._joint, lambda value: self._mark_joint())
        inputs.on_user(self._height, lambda value: state.move_root(1, value))
        self._mark_joint()

    @property
    def joint(self) -> int:
        """Number of the chosen joint."""
        return self._labels.get(self._joint.value, 0)

    def choose_joint(self, joint: int) -> None:
        """Choose a joint by its number; the root, which always has its own sliders, is ignored."""
        label = next((label for label, number in self._labels.items() if number == joint), None)
        if label is not None:
            self._joint.value = label
            self._mark_joint()

    def follow(self, picture: Picture) -> bool:
        """Update the sliders, unless a motion plays; return whether the pose has changed."""
        if picture.is_playing or picture.posed.number == self._seen_pose:
            return False
        self._seen_pose = picture.posed.number
        self._angles.show(picture.posed.pose[self.joint])
        self._turns.show(picture.posed.pose[0])
        self._height.value = rounded(np.clip(picture.posed.translation[1], -_REACH_M, _REACH_M), 2)
        return True

    def _add_angles(self, joint: Callable[[], int]) -> AngleSliders:
        state = self._state
        return AngleSliders(self._inputs, lambda: state.pause().pose[joint()], lambda vector: state.turn_joint(joint(), vector))

    def _mark_joint(self) -> None:
        self._scene.chosen_joint = self.joint
        self._seen_pose = -1
        self._state.change_look()

    def _press(self, button: str) -> None:
        if button == "Mirror":
            self._state.mirror_joint(self.joint)
        else:
            self._state.turn_joint(self.joint, np.zeros(3))

    def _save(self, client: Any) -> None:
        posed = self._state.posed
        client.send_file_download("pose.npz", pose_file(posed.pose, posed.translation), save_immediately=True)
