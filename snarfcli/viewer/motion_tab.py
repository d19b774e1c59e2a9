"""The tab of motions: motion, frame, speed and loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from snarfcli.errors import UserError
from snarfcli.names import unique_names
from snarfcli.texts import one_line
from snarfcli.viewer.inputs import Inputs
from snarfcli.viewer.picture import Picture
from snarfcli.viewer.state import ViewerState

__all__ = ["NO_MOTION", "MotionTab"]

NO_MOTION = "none"
_SPEEDS = (0.1, 2.0)
_LONGEST = 80  # characters of a name in the list


class MotionTab:
    """The inputs of the motion, added to the current container of viser.

    Args:
        inputs: makes the inputs.
        state: state of the viewer.
        motions: names of the motions that can be played.
        load_motion: returns the motion of a name and its bone transforms; raises UserError.
        first: name of the motion that is already loaded.
    """

    def __init__(
        self,
        inputs: Inputs,
        state: ViewerState,
        motions: Sequence[str],
        load_motion: Callable[[str], tuple[Any, Any]],
        first: str | None = None,
    ) -> None:
        self._state = state
        self._load_motion = load_motion
        shown = [one_line(name, _LONGEST) or "unnamed" for name in motions]  # names come from files
        self._names = dict(zip(unique_names([NO_MOTION, *shown])[1:], motions, strict=True))
        self._is_playing: bool | None = None
        self.notice: str | None = None
        """Why the chosen motion cannot be played, in one line; None if it can."""
        start = next((label for label, name in self._names.items() if name == first), NO_MOTION)
        self.names = inputs.add_dropdown("Motion", (NO_MOTION, *self._names), start)
        self._play = inputs.add_button("Play", lambda client: self._play_or_pause(), icon="player-play")
        self._frame = inputs.add_slider("Frame", 0, 1, 1, 0)
        speed = inputs.add_slider("Speed", *_SPEEDS, 0.1, 1.0, hint="1 is the original speed")
        loop = inputs.add_checkbox("Loop", state.player.is_looping)
        in_place = inputs.add_checkbox(
            "Stay in place", state.look.is_in_place, hint="the body keeps its height, but does not travel"
        )
        inputs.on_user(self.names, self.choose)
        inputs.on_user(self._frame, self._seek)
        inputs.on_user(speed, state.change_speed)
        inputs.on_user(loop, state.change_looping)
        inputs.on_user(in_place, lambda value: state.change_look(is_in_place=value))
        self._fit_frames()

    def choose(self, name: str) -> None:
        """Load and play the motion with this name in the list."""
        self.notice = None
        try:
            motion, transforms = (None, None) if name == NO_MOTION else self._load_motion(self._names[name])
        except UserError as error:
            self.notice = one_line(error)
            motion, transforms = None, None
        self._state.load_motion(motion, transforms)
        self._fit_frames()
        self._state.play()

    def follow(self, picture: Picture) -> None:
        """Update the label of the play button."""
        if picture.is_playing != self._is_playing:
            self._is_playing = picture.is_playing
            self._play.label = "Pause" if picture.is_playing else "Play"
            self._play.icon = "player-pause" if picture.is_playing else "player-play"

    def show_frame(self, frame: int) -> None:
        """Set the slider to the number of a frame."""
        if self._state.motion is not None:
            self._frame.value = min(frame, int(self._frame.max))

    def _fit_frames(self) -> None:
        """Set the range of the frame slider to the length of the motion."""
        count = self._state.player.num_frames
        self._frame.value = 0
        self._frame.max = max(count - 1, 1)
        self._frame.disabled = self._play.disabled = count < 2

    def _play_or_pause(self) -> None:
        if self._state.player.is_playing:
            self._state.pause()
        else:
            self._state.play()

    def _seek(self, frame: int) -> None:
        if self._state.motion is not None:
            self._state.pause()
            self._state.seek(frame)
