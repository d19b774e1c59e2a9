"""The panel of the page: tabs for motion, pose and look, and a status text."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from snarfcli.texts import markdown_text
from snarfcli.viewer.gate import Gate
from snarfcli.viewer.inputs import Inputs
from snarfcli.viewer.look_tab import LookTab
from snarfcli.viewer.motion_tab import MotionTab
from snarfcli.viewer.picture import Picture
from snarfcli.viewer.pose_tab import PoseTab
from snarfcli.viewer.scene import ViewerScene
from snarfcli.viewer.state import ViewerState

__all__ = ["Controls"]

_TEXT_EVERY_S = 0.25
_TITLE, _LONGEST_FACT = ("subject", "data", "model"), 60
_MEASURED, _MEASURED_S = 31, 6.0  # frames and seconds over which the frame rate is measured


class Controls:
    """The panel, shared by all clients.

    Args:
        server: server of viser.
        gate: told what the inputs offer.
        state: state of the viewer.
        scene: scene of the viewer.
        motions: names of the motions that can be played.
        load_motion: returns the motion of a name and its bone transforms; raises UserError.
        facts: names and values for the tab about the avatar.
        first_motion: name of the motion that is already loaded.
        clock: returns the time, seconds.
    """

    def __init__(
        self,
        server: Any,
        gate: Gate,
        state: ViewerState,
        scene: ViewerScene,
        motions: Sequence[str],
        load_motion: Callable[[str], tuple[Any, Any]],
        facts: Mapping[str, str],
        first_motion: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        gui, inputs = server.gui, Inputs(server.gui, gate)
        self._facts = facts
        self._clock = clock
        self._next_text = 0.0
        self._changes: list[float] = []  # times of recent changes of the shown pose
        self._shown_pose = -1
        gui.configure_theme(control_width="medium", show_share_button=False, show_logo=False)
        gui.set_panel_label("snarf view")
        self._text = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Motion"):
            self.motion = MotionTab(inputs, state, motions, load_motion, first_motion)
        with tabs.add_tab("Pose"):
            self.pose = PoseTab(inputs, state, scene)
        with tabs.add_tab("Look"):
            LookTab(inputs, state, scene)
        with tabs.add_tab("About"):
            rows = "\n".join(f"| {markdown_text(name)} | {markdown_text(value)} |" for name, value in facts.items())
            gui.add_markdown(f"| | |\n|---|---|\n{rows}")

    def follow(self, picture: Picture) -> float | None:
        """Update sliders and text; return the seconds until the text must be updated again, None for no update."""
        now = self._clock()
        if picture.shown.number != self._shown_pose:
            self._shown_pose = picture.shown.number
            self._changes.append(now)
        self.motion.follow(picture)
        if self.pose.follow(picture):
            self.motion.show_frame(picture.frame)
        if now < self._next_text:
            return self._next_text - now
        self._next_text = now + _TEXT_EVERY_S
        if picture.is_playing:
            self.motion.show_frame(picture.frame)
        self._text.content = self._status(picture, now)
        return _TEXT_EVERY_S if self._changes else None

    def _status(self, picture: Picture, now: float) -> str:
        """Return the status as Markdown: surface, frame rate and errors; texts of files are escaped."""
        self._changes = [changed for changed in self._changes[-_MEASURED:] if changed > now - _MEASURED_S]
        spans = len(self._changes) - 1
        rate = spans / max(self._changes[-1] - self._changes[0], 1e-3) if spans > 0 else 0.0
        title = " · ".join(markdown_text(self._facts[name], _LONGEST_FACT) for name in _TITLE if name in self._facts)
        mesh = picture.mesh
        parts = ["no surface yet"] if mesh is None else [mesh.surface, f"{len(mesh.vertices):,} vertices"]
        times = []
        if picture.is_playing:
            times.append(f"{rate:.{0 if rate >= 10 else 1}f} frames per second")
        elif picture.is_computing:
            times.append("computing …")
        if mesh is not None and mesh.seconds is not None:
            times.append(f"{'surface' if mesh.surface == 'field' else 'shape'} in {mesh.seconds:.2f} s")
        # a constant number of lines, so that the panel below does not jump
        lines = [f"**{title}**", " · ".join(parts), " · ".join(times) or "&nbsp;"]
        lines += [f"⚠ {markdown_text(text)}" for text in (self.motion.notice, picture.message) if text]
        return "  \n".join(lines)
