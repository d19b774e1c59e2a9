"""The playback position in a motion."""

from __future__ import annotations

import math

__all__ = ["Player"]


class Player:
    """A position in a motion that advances with time, or is paused.

    The caller passes the time, `now` in seconds, to each method; the player has no clock.
    """

    def __init__(self) -> None:
        self.num_frames = 0
        self.frame_rate = 30.0
        self.speed = 1.0
        self.is_looping = True
        self.is_playing = False
        self._position = 0.0  # in frames, at the time `_since`
        self._since = 0.0

    def load(self, num_frames: int, frame_rate: float) -> None:
        """Load another motion, paused at its first frame; 0 frames for no motion."""
        self.num_frames, self.frame_rate = num_frames, frame_rate
        self.is_playing = False
        self._position = 0.0

    def frame(self, now: float) -> int:
        """Return the number of the current frame; stop at the last one unless looping."""
        position = self._at(now)
        if self.is_playing and not self.is_looping and position >= self.num_frames - 1:
            self._position, self.is_playing = float(max(self.num_frames - 1, 0)), False
            position = self._position
        return int(position + 1e-9)

    def play(self, now: float) -> None:
        """Play from the current frame, or from the first one if this is the last. A single frame is not played."""
        if self.num_frames < 2 or self.is_playing:
            return
        if not self.is_looping and self._position >= self.num_frames - 1:
            self._position = 0.0
        self._since, self.is_playing = now, True

    def pause(self, now: float) -> None:
        """Pause at the current frame."""
        self._position = float(self.frame(now))
        self.is_playing = False

    def seek(self, frame: int, now: float) -> None:
        """Go to a frame; a playing motion continues from there."""
        self._position, self._since = float(min(max(frame, 0), max(self.num_frames - 1, 0))), now

    def change_speed(self, speed: float, now: float) -> None:
        """Set the speed; 1 is the original speed."""
        self._position, self._since, self.speed = self._at(now), now, speed

    def change_looping(self, is_looping: bool, now: float) -> None:
        """Set whether the motion restarts after its last frame, or stops there."""
        self._position, self._since, self.is_looping = self._at(now), now, is_looping

    def seconds_to_next(self, now: float) -> float | None:
        """Return the seconds until the next frame; None while paused."""
        if not self.is_playing:
            return None
        position = self._at(now)
        rate = self.frame_rate * self.speed
        return max((math.floor(position + 1e-9) + 1 - position) / rate, 0.0)

    def _at(self, now: float) -> float:
        """Return the position in frames, within the motion."""
        if not self.is_playing:
            return self._position
        position = self._position + (now - self._since) * self.frame_rate * self.speed
        return position % self.num_frames if self.is_looping else min(position, float(self.num_frames - 1))
