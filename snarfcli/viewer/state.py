"""State of the viewer, independent of the web page: pose, motion and look, and the picture that they give."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions import Motion
from snarfcli.viewer.body import Posed, ShapeRequest, ViewerBody
from snarfcli.viewer.joints import mirrored_joint
from snarfcli.viewer.picture import Picture, ViewerLook
from snarfcli.viewer.player import Player
from snarfcli.viewer.surface_cache import SurfaceCache
from snarfcli.viewer.worker import BackgroundWorker

__all__ = ["ViewerState"]

_SHAPE_EVERY_S = 0.1  # while playing
_FLOOR_FRAMES = 40  # frames of a motion in which the floor is searched for


class ViewerState:
    """Pose, motion and look, shared by all clients.

    Any thread may change it. One thread calls `picture` after each `wake`, and when the time that it returned has passed.

    Args:
        body: computes the surfaces of the avatar.
        look: initial look.
        wake: called after every change.
        clock: returns the time, seconds.
    """

    def __init__(
        self, body: ViewerBody, look: ViewerLook, wake: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.body = body
        self.look = look if body.has_weights else replace(look, surface="field", weight_colors=False, shows_canonical=False)
        self.player = Player()
        self.motion: Motion | None = None
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
        """The current pose."""
        with self._lock:
            return self._posed

    def turn_joint(self, joint: int, vector: NDArray[np.float64]) -> None:
        """Set the rotation vector [3] of a joint, radians, relative to its parent; joint 0 rotates the whole body."""
        with self._lock:
            pose = self._paused().pose.copy()
            pose[joint] = vector
            self._set_pose(pose, self._posed.translation)

    def mirror_joint(self, joint: int) -> None:
        """Copy the rotation of a joint, mirrored, to the joint on the other side."""
        with self._lock:
            other, vector = mirrored_joint(self.body.skeleton, joint, self._paused().pose[joint])
            if other != joint:
                self.turn_joint(other, vector)

    def move_root(self, axis: int, metres: float) -> None:
        """Set the translation of the root along one axis, metres."""
        with self._lock:
            translation = self._paused().translation.copy()
            translation[axis] = metres
            self._set_pose(self._posed.pose, translation)

    def reset_pose(self) -> None:
        """Stand on the floor in the rest pose."""
        with self._lock:
            self.player.pause(self._clock())
            self._set_pose(np.zeros_like(self._posed.pose), np.zeros(3))
            self._stand_on_floor()

    # ---------------------------------------------------------------- the motion
    def load_motion(self, motion: Motion | None, bone_transforms: NDArray[np.float32] | None = None) -> None:
        """Load a motion and go to its first frame; None removes the motion and keeps the pose.

        Args:
            motion: motion of the skeleton of the avatar.
            bone_transforms: [T, J, 4, 4], canonical to posed, metres; needed where joints stretch, which poses cannot express.
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
        """Play the motion."""
        with self._lock:
            self.player.play(self._clock())
            self._wake()

    def pause(self) -> Posed:
        """Pause the motion; return its current pose."""
        with self._lock:
            self._wake()
            return self._paused()

    def seek(self, frame: int) -> None:
        """Go to a frame of the motion."""
        with self._lock:
            self.player.seek(frame, self._clock())
            self._go_to(self.player.frame(self._clock()))

    def change_speed(self, speed: float) -> None:
        """Set the speed; 1 is the original speed."""
        with self._lock:
            self.player.change_speed(speed, self._clock())
            self._wake()

    def change_looping(self, is_looping: bool) -> None:
        """Set whether the motion restarts after its last frame."""
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
        """Stop computing surfaces."""
        self._worker.stop()

    # ---------------------------------------------------------------- the picture
    def picture(self) -> tuple[Picture, float | None]:
        """Return the current picture, and the seconds until the next one is due; None for not before `wake` is called."""
        with self._lock:
            now = self._clock()
            frame = self.player.frame(now)
            if self.motion is not None and frame != self._frame:
                self._go_to(frame)
            outcome = self._worker.take()
            if outcome is not None and self._surfaces.store(*outcome):  # now the lowest point of the feet is known
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
    def _paused(self) -> Posed:
        """Pause at the current frame, and return its pose."""
        now = self._clock()
        self.player.pause(now)
        if self.motion is not None and self.player.frame(now) != self._frame:
            self._go_to(self.player.frame(now))
        return self._posed

    def _set_pose(
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
        """Set the pose to that of a frame of the motion."""
        self._frame = frame
        self._set_pose(*self._pose_of_frame(frame))

    def _pose_of_frame(self, frame: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32] | None]:
        """Return pose, translation and, if given, bone transforms of a frame; without horizontal translation if in place."""
        assert self.motion is not None
        pose, translation = self.motion.poses[frame], self.motion.translation[frame].copy()
        transforms = None if self._motion_transforms is None else self._motion_transforms[frame].copy()
        if self.look.is_in_place:
            if transforms is not None:
                transforms[:, [0, 2], 3] -= translation[[0, 2]].astype(np.float32)
            translation[[0, 2]] = 0
        return pose, translation, transforms

    def _stand_on_floor(self) -> None:
        """Move the body vertically so that it stands on the floor."""
        low = self._surfaces.lowest(self._posed.transforms)
        translation = np.add(self._posed.translation, (0.0, self.floor_y - low, 0.0))
        self._set_pose(self._posed.pose, translation)

    def _find_floor(self) -> None:
        """Set the height of the floor to the lowest point of the motion; without one, of the body in its rest pose."""
        if self.motion is None:
            zeros = np.zeros_like(self._posed.pose)
            self.floor_y = self._surfaces.lowest(self.body.transforms(zeros, np.zeros(3)))
            return
        frames = np.unique(np.linspace(0, self.motion.num_frames - 1, _FLOOR_FRAMES).astype(int))
        lowest = []
        for frame in frames:
            pose, translation, transforms = self._pose_of_frame(frame)
            lowest.append(self._surfaces.lowest(self.body.transforms(pose, translation) if transforms is None else transforms))
        self.floor_y = min(lowest)
