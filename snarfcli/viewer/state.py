"""The viewer without its page: pose, motion and look as they were chosen, and which picture follows from them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.viewer.body import Posed, ShapeRequest, ViewerBody
from snarfcli.viewer.joints import mirrored_joint
from snarfcli.viewer.picture import Picture, ViewerLook
from snarfcli.viewer.player import Player
from snarfcli.viewer.surface_cache import SurfaceCache
from snarfcli.viewer.worker import BackgroundWorker

__all__ = ["ViewerState"]

_SHAPE_EVERY_S = 0.1  # while playing
_FLOOR_FRAMES = 40  # of a motion, looked at to find its floor


class ViewerState:
    """What was chosen on the page, by whoever looks at it: everybody sees and changes the same.

    Changes may come from any thread. One thread calls `picture` whenever `wake` was called or the time it was told is over.

    Args:
        body: the avatar.
        look: how it is shown at first.
        wake: called after every change.
        clock: seconds.
    """

    def __init__(
        self, body: ViewerBody, look: ViewerLook, wake: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.body = body
        self.look = look if body.has_weights else replace(look, surface="field", weight_colors=False, shows_canonical=False)
        self.player = Player()
        self.motion: Any = None
        """The motion, with `poses` [T, J, 3] and `translation` [T, 3]; None for none."""
        self.floor_y = 0.0
        """Height of the floor, metres."""
        self._motion_transforms: NDArray[np.float32] | None = None
        self._wake = wake
        self._clock = clock
        self._lock = threading.RLock()
        self._worker = BackgroundWorker(body.make, wake)
        self._frame = 0
        self._next_shape = 0.0
        self._surfaces = SurfaceCache(body)
        zeros = np.zeros((body.skeleton.num_joints, 3))
        self._posed = Posed(0, zeros, np.zeros(3), body.transforms(zeros, np.zeros(3)))
        self._find_floor()

    # ---------------------------------------------------------------- the pose
    @property
    def posed(self) -> Posed:
        """The pose that is wanted."""
        with self._lock:
            return self._posed

    def turn_joint(self, joint: int, vector: NDArray[np.float64]) -> None:
        """Give a joint the rotation vector [3], radians, relative to its parent; 0 turns the whole body."""
        with self._lock:
            pose = self._held().pose.copy()
            pose[joint] = vector
            self._take(pose, self._posed.translation)

    def mirror_joint(self, joint: int) -> None:
        """Turn the joint on the other side as this one is turned, mirrored."""
        with self._lock:
            other, vector = mirrored_joint(self.body.skeleton, joint, self._held().pose[joint])
            if other != joint:
                self.turn_joint(other, vector)

    def move_root(self, axis: int, metres: float) -> None:
        """Put the root at so many metres from its place at rest, along one axis."""
        with self._lock:
            translation = self._held().translation.copy()
            translation[axis] = metres
            self._take(self._posed.pose, translation)

    def reset_pose(self) -> None:
        """Stand on the floor in the rest pose."""
        with self._lock:
            self.player.pause(self._clock())
            self._take(np.zeros_like(self._posed.pose), np.zeros(3))
            self._stand()

    # ---------------------------------------------------------------- the motion
    def load_motion(self, motion: Any, bone_transforms: NDArray[np.float32] | None = None) -> None:
        """Take a motion and go to its first frame; None takes it away, and the pose stays as it is.

        Args:
            motion: `Motion` of the avatar's skeleton.
            bone_transforms: [T, J, 4, 4] canonical to posed, metres, where joints stretch; None where the poses say it all.
        """
        with self._lock:
            self.motion, self._motion_transforms = motion, bone_transforms
            if motion is None:
                self.player.load(0, 30.0)
                self._wake()
                return
            self.player.load(motion.num_frames, motion.frame_rate)
            self._find_floor()
            self._go_to(0)

    def play(self) -> None:
        """Let the motion run."""
        with self._lock:
            self.player.play(self._clock())
            self._wake()

    def pause(self) -> Posed:
        """Hold the motion; return the pose that it is held in."""
        with self._lock:
            self._wake()
            return self._held()

    def seek(self, frame: int) -> None:
        """Go to a frame of the motion."""
        with self._lock:
            self.player.seek(frame, self._clock())
            self._go_to(self.player.frame(self._clock()))

    def change_speed(self, speed: float) -> None:
        """Play so many times as fast as the motion was."""
        with self._lock:
            self.player.change_speed(speed, self._clock())
            self._wake()

    def change_looping(self, is_looping: bool) -> None:
        """Start again after the last frame, or not."""
        with self._lock:
            self.player.change_looping(is_looping, self._clock())
            self._wake()

    # ---------------------------------------------------------------- the look
    def change_look(self, **changes: Any) -> None:
        """Change fields of the look."""
        with self._lock:
            in_place = self.look.is_in_place
            self.look = replace(self.look, **changes)
            if self.look.is_in_place != in_place and self.motion is not None:
                self._find_floor()
                self._go_to(self._frame)
            self._wake()

    def stop(self) -> None:
        """Make no more surfaces."""
        self._worker.stop()

    # ---------------------------------------------------------------- the picture
    def picture(self) -> tuple[Picture, float | None]:
        """Return what is to be seen now, and for how many seconds at most; None for until `wake` is called."""
        with self._lock:
            now = self._clock()
            frame = self.player.frame(now)
            if self.motion is not None and frame != self._frame:
                self._go_to(frame)
            outcome = self._worker.take()
            if outcome is not None and self._surfaces.keep(*outcome):  # now it is known how far down the feet reach
                self._find_floor()
            posed, look = self._posed, self.look
            requests = self._surfaces.wanted(posed, look)
            # the shape changes slowly: while playing, leave the processor to the browser in between
            may_shape = not self.player.is_playing or now >= self._next_shape
            due = next((request for request in requests if may_shape or not isinstance(request, ShapeRequest)), None)
            if due is not None and self._worker.start(due) and isinstance(due, ShapeRequest):
                self._next_shape = now + _SHAPE_EVERY_S
            picture = Picture(
                look,
                self.floor_y,
                posed,
                self._surfaces.shown(posed, look, self.player.is_playing),
                self._surfaces.canonical(look) if look.shows_canonical else None,
                self._frame,
                self.player.is_playing,
                bool(requests),
                self._surfaces.problem,
            )
            return picture, self.player.seconds_to_next(now)

    # ---------------------------------------------------------------- changes
    def _held(self) -> Posed:
        """Stop playing at the frame that is due, and return its pose."""
        now = self._clock()
        self.player.pause(now)
        if self.motion is not None and self.player.frame(now) != self._frame:
            self._go_to(self.player.frame(now))
        return self._posed

    def _take(
        self,
        pose: NDArray[np.float64],
        translation: NDArray[np.float64],
        transforms: NDArray[np.float32] | None = None,
    ) -> None:
        if transforms is None:
            transforms = self.body.transforms(pose, translation)
        self._posed = Posed(self._posed.number + 1, pose, translation, transforms)
        self._wake()

    def _go_to(self, frame: int) -> None:
        """Take the pose of a frame of the motion."""
        self._frame = frame
        self._take(*self._of_frame(frame))

    def _of_frame(self, frame: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32] | None]:
        """Return pose, translation and, where joints stretch, bone transforms of a frame, over one spot if so wished."""
        pose, translation = self.motion.poses[frame], self.motion.translation[frame].copy()
        transforms = None if self._motion_transforms is None else self._motion_transforms[frame].copy()
        if self.look.is_in_place:
            if transforms is not None:
                transforms[:, [0, 2], 3] -= translation[[0, 2]].astype(np.float32)
            translation[[0, 2]] = 0
        return pose, translation, transforms

    def _stand(self) -> None:
        """Put the body onto the floor by its height."""
        low = self._surfaces.lowest(self._posed.transforms)
        translation = np.add(self._posed.translation, (0.0, self.floor_y - low, 0.0))
        self._take(self._posed.pose, translation)

    def _find_floor(self) -> None:
        """Put the floor below the lowest point of the motion; without one, below the body in its rest pose."""
        if self.motion is None:
            zeros = np.zeros_like(self._posed.pose)
            self.floor_y = self._surfaces.lowest(self.body.transforms(zeros, np.zeros(3)))
            return
        frames = np.unique(np.linspace(0, self.motion.num_frames - 1, _FLOOR_FRAMES).astype(int))
        lowest = []
        for frame in frames:
            pose, translation, transforms = self._of_frame(frame)
            lowest.append(self._surfaces.lowest(self.body.transforms(pose, translation) if transforms is None else transforms))
        self.floor_y = min(lowest)
