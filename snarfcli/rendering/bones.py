"""A picture of meshes with the bones of a skeleton drawn over them, to check that they match."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from snarfcli.bodies import Skeleton
from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.lighting import Look
from snarfcli.rendering.render import render
from snarfcli.rendering.sheet import contact_sheet, write_png

__all__ = ["BonedMesh", "write_bones_figure"]

_PANEL = 360  # pixels
_VIEWS = (("from the front", 20.0), ("from the side", 100.0))
_ELEVATION_RAD = math.radians(10)
_BONE, _JOINT, _ROOT, _RIM = (235, 94, 40), (255, 214, 102), (200, 30, 120), (40, 20, 10)  # sRGB
_LOOK = Look(body=(0.62, 0.68, 0.74))  # paler than usual, so that the bones are visible


class BonedMesh(Protocol):
    """A posed mesh with its posed joints."""

    @property
    def label(self) -> str: ...
    @property
    def vertices(self) -> np.ndarray: ...
    @property
    def faces(self) -> np.ndarray: ...
    @property
    def joints(self) -> np.ndarray: ...


def write_bones_figure(path: Path, title: str, skeleton: Skeleton, frames: Sequence[BonedMesh]) -> None:
    """Draw each frame from two sides, bones over the mesh, and write the sheet as PNG, whole or not at all."""
    rows = []
    for _, azimuth_deg in _VIEWS:
        rows.append([_panel(skeleton, frame, math.radians(azimuth_deg)) for frame in frames])
    labels = [f"{name}; orange: bones, yellow: joints, red: roots" for name, _ in _VIEWS]
    sheet = contact_sheet(rows, row_labels=labels, column_labels=[frame.label for frame in frames], title=title)
    write_png(path, sheet)


def _panel(skeleton: Skeleton, frame: BonedMesh, azimuth_rad: float) -> np.ndarray:
    from PIL import Image, ImageDraw

    mesh = Mesh(frame.vertices.astype(np.float32), frame.faces.astype(np.int32))
    seen = np.concatenate([frame.vertices, frame.joints])
    camera = Camera.framing(seen, azimuth_rad=azimuth_rad, elevation_rad=_ELEVATION_RAD)
    picture = Image.fromarray(render(mesh, camera, _PANEL, look=_LOOK))
    draw = ImageDraw.Draw(picture)
    places = [tuple(place) for place in camera.project(frame.joints, _PANEL, _PANEL)[:, :2]]
    for width, color in ((5, _RIM), (3, _BONE)):
        for parent, child in skeleton.bones:
            draw.line((places[parent], places[child]), fill=color, width=width)
    for (x, y), parent in zip(places, skeleton.parents, strict=True):
        radius = 5 if parent < 0 else 3
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=_ROOT if parent < 0 else _JOINT, outline=_RIM)
    return np.asarray(picture)
