"""Pictures of several panels, one per content and view, side by side with labels below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from snarfcli.errors import UserError
from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.floor import Backdrop
from snarfcli.rendering.lighting import Look, Solid
from snarfcli.rendering.render import render
from snarfcli.rendering.sheet import text_strip
from snarfcli.rendering.stage import Stage

__all__ = ["LARGEST_SIDE", "Screen", "picture_size"]

LARGEST_SIDE = 8192
"""Maximum width and height of a picture, pixels: twice what many players show."""
_MOST_PIXELS = 4096 * 4096
_LOOK = Look()
_SEAM = (255, 255, 255)


def picture_size(size: tuple[int, int], contents: int, views: int) -> tuple[int, int]:
    """Return the size, (width, height) in pixels, of a picture with panels of `size`.

    Raises:
        UserError: it is larger than the maximum size of a video.
    """
    columns, rows = _layout(contents, views)
    strip = 0 if contents * views == 1 else text_strip(["x"], size[0]).shape[0]
    width, height = columns * size[0] + columns - 1, rows * (size[1] + strip)
    if max(width, height) > LARGEST_SIDE or width * height > _MOST_PIXELS:
        raise UserError(
            f"video_size: wanted a picture of at most 4096 x 4096 pixels and {LARGEST_SIDE} one way, got {width} x {height} of"
            f" {contents * views} panels of {size[0]} x {size[1]}; give a smaller video_size, which is that of one panel"
        )
    return width, height


def _layout(contents: int, views: int) -> tuple[int, int]:
    """Return the number of columns and rows: one row, or one row per content if there are several views."""
    return (views, contents) if min(contents, views) > 1 else (contents * views, 1)


class Screen:
    """Draws pictures of panels, each with its camera.

    Args:
        stage: cameras and floor.
        size: (width, height) of one panel, pixels.
        contents: content of each row or column, and its label.
        settled: contents that stay at x = z = 0 while the body moves.
    """

    def __init__(self, stage: Stage, size: tuple[int, int], contents: Mapping[str, str], settled: Sequence[str] = ()) -> None:
        self.stage, self.size, self.contents, self.settled = stage, size, dict(contents), tuple(settled)
        self.columns, self.rows = _layout(len(self.contents), len(stage.views))
        self._backdrops: dict[tuple[int, bool], Backdrop] = {}

    def __getstate__(self) -> dict:
        """Leave out cached images, which are large and fast to compute."""
        return {**{name: value for name, value in vars(self).items() if name != "_strips"}, "_backdrops": {}}

    def draw(self, frame: int, shown: Mapping[str, Mesh | None]) -> np.ndarray:
        """Draw one frame.

        Args:
            frame: number of the frame.
            shown: mesh of each content; None leaves its stage empty.

        Returns:
            [H, W, 3] uint8, sRGB.
        """
        panels = []
        for content in self.contents:
            mesh = shown[content]
            solid = Solid(mesh) if mesh is not None and len(mesh.faces) else None
            for view in range(len(self.stage.views)):
                backdrop = self._backdrop(view, frame, content in self.settled)
                panels.append(render(solid, backdrop.camera, self.size, look=_LOOK, backdrop=backdrop))
        if len(panels) == 1:
            return panels[0]
        seam = np.full((self.size[1], 1, 3), _SEAM, dtype=np.uint8)
        rows = []
        for row in range(self.rows):
            parts = [part for panel in panels[row * self.columns : (row + 1) * self.columns] for part in (seam, panel)][1:]
            rows += [np.concatenate(parts, axis=1), self._strips[row]]
        return np.concatenate(rows)

    @cached_property
    def _strips(self) -> list[np.ndarray]:
        """Labels below each row of panels, [H, W, 3]."""
        views = [view.label for view in self.stage.views]
        if len(views) == 1:
            labels = list(self.contents.values())
        elif len(self.contents) == 1:
            labels = views
        else:
            labels = [f"{content}, {view}" for content in self.contents.values() for view in views]
        return [text_strip(labels[row * self.columns :][: self.columns], self.size[0]) for row in range(self.rows)]

    def _backdrop(self, view: int, frame: int, is_settled: bool) -> Backdrop:
        """Return the empty stage of a view, cached while its camera does not move."""
        known = self._backdrops.get((view, is_settled))
        if known is not None and self.stage.is_still:
            return known
        camera = self._camera(view, frame, is_settled)
        backdrop = Backdrop(camera, self.size, self.stage.floor, _LOOK)
        if self.stage.is_still:
            self._backdrops[view, is_settled] = backdrop
        return backdrop

    def _camera(self, view: int, frame: int, is_settled: bool) -> Camera:
        return self.stage.camera_on(view, frame, np.zeros(3)) if is_settled else self.stage.camera(view, frame)
