"""The panel of the page: pose, motion and look; it says what is shown and passes on what is chosen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from snarfcli.errors import UserError
from snarfcli.viewer.inputs import AngleSliders, on_user, rounded
from snarfcli.viewer.joints import joint_labels, pose_file
from snarfcli.viewer.picture import RESOLUTIONS, SURFACE_NAMES, Picture
from snarfcli.viewer.scene import Scene
from snarfcli.viewer.viewing import Viewing

__all__ = ["NO_MOTION", "Controls"]

NO_MOTION = "none"
_SPEEDS = (0.1, 2.0)
_TEXT_EVERY_S = 0.25
_MEASURED, _MEASURED_S = 31, 6.0  # frames and seconds that the rate is measured over
_REACH_M = 3.0  # of the slider for the height, about the body's size of a person


class Controls:
    """The panel that all who look see.

    Args:
        server: viser's.
        viewing: what is shown.
        scene: where it is shown.
        motions: names of the motions that can be played.
        load_motion: returns the motion of a name and its bone transforms; raises UserError.
        facts: what is told about the avatar, name and value.
        first_motion: name of the motion that is loaded already.
        clock: seconds.
    """

    def __init__(
        self,
        server: Any,
        viewing: Viewing,
        scene: Scene,
        motions: Sequence[str],
        load_motion: Callable[[str], tuple[Any, Any]],
        facts: Mapping[str, str],
        first_motion: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._gui = server.gui
        self._server = server
        self._viewing = viewing
        self._scene = scene
        self._load_motion = load_motion
        self._facts = facts
        self._clock = clock
        self._labels = joint_labels(viewing.body.skeleton)
        self._next_text = 0.0
        self._changes: list[float] = []  # when another pose was shown, of late
        self._seen_pose = -1  # which pose the sliders stand for
        self._shown_pose = -1
        self._is_playing: bool | None = None
        self._notice: str | None = None
        server.gui.configure_theme(control_width="medium", show_share_button=False, show_logo=False)
        server.gui.set_panel_label("snarf view")
        self._text = server.gui.add_markdown("")
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Motion"):
            self._add_motion(motions, first_motion)
        with tabs.add_tab("Pose"):
            self._add_pose()
        with tabs.add_tab("Look"):
            self._add_look()
        with tabs.add_tab("About"):
            rows = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
            server.gui.add_markdown(f"| | |\n|---|---|\n{rows}")

    # ---------------------------------------------------------------- the panel
    def _add_motion(self, motions: Sequence[str], first: str | None) -> None:
        gui = self._gui
        self._motion = gui.add_dropdown("Motion", (NO_MOTION, *motions), initial_value=first or NO_MOTION)
        self._play = gui.add_button("Play", icon="player-play")
        self._frame = gui.add_slider("Frame", 0, 1, 1, 0)
        speed = gui.add_slider("Speed", *_SPEEDS, 0.1, 1.0, hint="times the motion's own pace")
        loop = gui.add_checkbox("Loop", self._viewing.player.is_looping)
        in_place = gui.add_checkbox(
            "Stay in place", self._viewing.look.is_in_place, hint="the body keeps its height, but does not travel"
        )
        on_user(self._motion, lambda handle, client: self._choose_motion(handle.value, client))
        self._play.on_click(lambda event: self._play_or_pause())
        on_user(self._frame, lambda handle, client: self._seek(handle.value))
        on_user(speed, lambda handle, client: self._viewing.change_speed(handle.value))
        on_user(loop, lambda handle, client: self._viewing.change_looping(handle.value))
        on_user(in_place, lambda handle, client: self._viewing.change_look(is_in_place=handle.value))
        self._fit_frames()

    def _add_pose(self) -> None:
        gui = self._gui
        with gui.add_folder("Joint", visible=bool(self._labels)):  # a skeleton of one joint has its root only
            joints = tuple(self._labels) or ("none",)
            self._joint = gui.add_dropdown("Joint", joints, hint="or click one in the picture (Look: skeleton)")
            self._angles = self._add_angles(lambda: self.joint)
            buttons = gui.add_button_group("", ("Straight", "Mirror"), hint="mirror: turn the joint of the other side alike")
        with gui.add_folder("Whole body"):
            self._turns = self._add_angles(lambda: 0)
            self._height = gui.add_slider("height", -_REACH_M, _REACH_M, 0.01, 0.0, hint="metres above its place at rest")
        reset = gui.add_button("Reset pose", icon="refresh")
        save = gui.add_button("Save pose", icon="download", hint="as .npz, which --pose reads again")
        on_user(self._joint, lambda handle, client: self._scene_joint())
        on_user(self._height, lambda handle, client: self._viewing.move_root(1, handle.value))
        buttons.on_click(lambda event: self._press(event.target.value))
        reset.on_click(lambda event: self._viewing.reset_pose())
        save.on_click(lambda event: self._save(event.client))
        self._scene_joint()

    def _add_angles(self, joint: Callable[[], int]) -> AngleSliders:
        viewing = self._viewing
        return AngleSliders(
            self._gui, lambda: viewing.pause().pose[joint()], lambda vector: viewing.turn_joint(joint(), vector)
        )

    def _add_look(self) -> None:
        gui, look = self._gui, self._viewing.look
        has_weights = self._viewing.body.has_weights
        surfaces = SURFACE_NAMES if has_weights else ("field",)
        surface = gui.add_dropdown(
            "Surface", surfaces, initial_value=look.surface, hint="skinned: at once; field: exact where the body meets itself"
        )
        self._skinned_resolution, self._field_resolution = (
            gui.add_dropdown("Resolution", tuple(map(str, sorted({*RESOLUTIONS, number}))), initial_value=str(number))
            for number in (look.skinned_resolution, look.field_resolution)
        )
        self._show_resolution(look.surface)
        pose_shape = gui.add_checkbox("Shape of the pose", look.has_pose_shape, hint="or that of the canonical pose")
        weights = gui.add_checkbox("Weights in colour", look.weight_colors)
        canonical = gui.add_checkbox("Canonical shape beside it", look.shows_canonical)
        skeleton = gui.add_checkbox("Skeleton", look.shows_skeleton, hint="click a joint to choose it")
        handle_box = gui.add_checkbox("Handle at the joint", False, hint="turn the chosen joint in the picture")
        wireframe = gui.add_checkbox("Wireframe", False)
        color = gui.add_rgb("Body", self._scene.body_color)
        camera = gui.add_button("Frame the body", icon="focus-2")
        for box in (pose_shape, weights, canonical):
            box.visible = has_weights

        def change(name: str, convert: Callable[[Any], Any] = lambda value: value) -> Callable[[Any, Any], None]:
            return lambda handle, client: self._viewing.change_look(**{name: convert(handle.value)})

        def change_surface(handle: Any, client: Any) -> None:
            self._show_resolution(handle.value)
            self._viewing.change_look(surface=handle.value)

        def change_handle(handle: Any, client: Any) -> None:
            self._scene.shows_handle = handle.value
            if handle.value and not skeleton.value:
                skeleton.value = True
            self._viewing.change_look(shows_skeleton=skeleton.value)

        def change_scene(name: str) -> Callable[[Any, Any], None]:
            def change_it(handle: Any, client: Any) -> None:
                setattr(self._scene, name, handle.value)
                self._viewing.change_look()

            return change_it

        on_user(surface, change_surface)
        on_user(self._skinned_resolution, change("skinned_resolution", int))
        on_user(self._field_resolution, change("field_resolution", int))
        on_user(pose_shape, change("has_pose_shape"))
        on_user(weights, change("weight_colors"))
        on_user(canonical, change("shows_canonical"))
        on_user(skeleton, change("shows_skeleton"))
        on_user(handle_box, change_handle)
        on_user(wireframe, change_scene("is_wireframe"))
        on_user(color, change_scene("body_color"))
        camera.on_click(lambda event: event.client and self._scene.frame_body(event.client.camera))

    # ---------------------------------------------------------------- what was chosen
    @property
    def joint(self) -> int:
        """Number of the chosen joint."""
        return self._labels.get(self._joint.value, 0)

    def choose_joint(self, joint: int) -> None:
        """Choose a joint by its number, as by a click; the root is always at hand."""
        label = next((label for label, number in self._labels.items() if number == joint), None)
        if label is not None:
            self._joint.value = label
            self._scene_joint()

    def _scene_joint(self) -> None:
        self._scene.chosen_joint = self.joint
        self._seen_pose = -1
        self._viewing.change_look()

    def _press(self, button: str) -> None:
        if button == "Mirror":
            self._viewing.mirror_joint(self.joint)
        else:
            self._viewing.turn_joint(self.joint, np.zeros(3))

    def _save(self, client: Any) -> None:
        if client is not None:
            posed = self._viewing.posed
            client.send_file_download("pose.npz", pose_file(posed.pose, posed.translation), save_immediately=True)

    def _choose_motion(self, name: str, client: Any) -> None:
        self._notice = None
        try:
            motion, transforms = (None, None) if name == NO_MOTION else self._load_motion(name)
        except UserError as error:
            self._notice = " ".join(str(error).split())
            motion, transforms = None, None
        self._viewing.load_motion(motion, transforms)
        self._fit_frames()
        self._viewing.play()

    def _fit_frames(self) -> None:
        """Give the frame's slider the length of the motion."""
        count = self._viewing.player.num_frames
        self._frame.value = 0
        self._frame.max = max(count - 1, 1)
        self._frame.disabled = self._play.disabled = count < 2

    def _play_or_pause(self) -> None:
        if self._viewing.player.is_playing:
            self._viewing.pause()
        else:
            self._viewing.play()

    def _seek(self, frame: int) -> None:
        if self._viewing.motion is not None:
            self._viewing.pause()
            self._viewing.seek(int(frame))

    def _show_resolution(self, surface: str) -> None:
        self._skinned_resolution.visible = surface == "skinned"
        self._field_resolution.visible = surface == "field"

    # ---------------------------------------------------------------- what is said
    def follow(self, picture: Picture) -> float | None:
        """Bring sliders and text up to date; return for how many seconds nothing more has to be said."""
        now = self._clock()
        if picture.shown.number != self._shown_pose:
            self._shown_pose = picture.shown.number
            self._changes.append(now)
        if picture.is_playing != self._is_playing:
            self._is_playing = picture.is_playing
            self._play.label = "Pause" if picture.is_playing else "Play"
            self._play.icon = "player-pause" if picture.is_playing else "player-play"
        if not picture.is_playing and picture.posed.number != self._seen_pose:
            self._seen_pose = picture.posed.number
            self._angles.show(picture.posed.pose[self.joint])
            self._turns.show(picture.posed.pose[0])
            self._height.value = rounded(np.clip(picture.posed.translation[1], -_REACH_M, _REACH_M), 2)
            self._set_frame(picture.frame)
        if now < self._next_text:
            return self._next_text - now
        self._next_text = now + _TEXT_EVERY_S
        if picture.is_playing:
            self._set_frame(picture.frame)
        self._text.content = self._status(picture, now)
        return _TEXT_EVERY_S if self._changes else None

    def _set_frame(self, frame: int) -> None:
        if self._viewing.motion is not None:
            self._frame.value = min(frame, int(self._frame.max))

    def _status(self, picture: Picture, now: float) -> str:
        """Return what is shown, how fast, and what went wrong, as Markdown."""
        self._changes = [time for time in self._changes[-_MEASURED:] if time > now - _MEASURED_S]
        spans = len(self._changes) - 1
        rate = spans / max(self._changes[-1] - self._changes[0], 1e-3) if spans > 0 else 0.0
        title = " · ".join(value for name, value in self._facts.items() if name in ("subject", "data", "model"))
        mesh = picture.mesh
        parts = ["no surface yet"] if mesh is None else [mesh.surface, f"{len(mesh.vertices):,} vertices"]
        times = []
        if picture.is_playing:
            times.append(f"{rate:.{0 if rate >= 10 else 1}f} frames a second")
        elif picture.is_computing:
            times.append("computing …")
        if mesh is not None and mesh.seconds is not None:
            times.append(f"{'made' if mesh.surface == 'field' else 'shape'} in {mesh.seconds:.2f} s")
        # always so many lines: what is below must not jump
        lines = [f"**{title}**", " · ".join(parts), " · ".join(times) or "&nbsp;"]
        lines += [f"⚠ {text}" for text in (self._notice, picture.message) if text]
        return "  \n".join(lines)
