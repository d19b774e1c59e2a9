"""Pictures of skeletons, with or without a mesh below the bones, to check that they match each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from snarfcli.bodies import Skeleton
from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.lighting import Look
from snarfcli.rendering.render import render
from snarfcli.rendering.sheet import contact_sheet, write_png

__all__ = ["BonedMesh", "PosedSkeleton", "write_bones_figure", "write_skeletons_figure"]

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


@dataclass(frozen=True, eq=False)
class PosedSkeleton:
    """The joints of a skeleton in one pose, y up, metres."""

    joints: np.ndarray
    """[J, 3]."""
    parents: Sequence[int]
    """J parents, -1 for a root."""
    mesh: Mesh | None = None
    """The mesh below the bones, if there is one."""
    heading_rad: float = 0.0
    """Direction in which the person looks: 0 is +z, a quarter turn +x."""


def write_bones_figure(path: Path, title: str, skeleton: Skeleton, frames: Sequence[BonedMesh]) -> None:
    """Draw each frame from two sides, bones over the mesh, and write the sheet as PNG, whole or not at all."""
    posed = []
    for frame in frames:
        mesh = Mesh(frame.vertices.astype(np.float32), frame.faces.astype(np.int32))
        posed.append(PosedSkeleton(frame.joints, skeleton.parents, mesh))
    rows = [[_panel(each, math.radians(azimuth_deg)) for each in posed] for _, azimuth_deg in _VIEWS]
    labels = [f"{name}; orange: bones, yellow: joints, red: roots" for name, _ in _VIEWS]
    sheet = contact_sheet(rows, row_labels=labels, column_labels=[frame.label for frame in frames], title=title)
    write_png(path, sheet)


def write_skeletons_figure(
    path: Path, title: str, columns: Sequence[str], rows: Sequence[tuple[str, Sequence[PosedSkeleton]]]
) -> None:
    """Draw rows of skeletons, each from the front of the person, and write the sheet as PNG, whole or not at all.

    Args:
        path: the file.
        title: line at the top.
        columns: labels of the columns.
        rows: label and skeletons of each row, one skeleton per column.
    """
    azimuth = math.radians(_VIEWS[0][1])
    pictures = [[_panel(each, each.heading_rad + azimuth) for each in row] for _, row in rows]
    sheet = contact_sheet(pictures, row_labels=[label for label, _ in rows], column_labels=list(columns), title=title)
    write_png(path, sheet)


def _panel(posed: PosedSkeleton, azimuth_rad: float) -> np.ndarray:
    from PIL import Image, ImageDraw

    mesh = posed.mesh
    seen = posed.joints if mesh is None else np.concatenate([mesh.vertices, posed.joints])
    camera = Camera.framing(seen, azimuth_rad=azimuth_rad, elevation_rad=_ELEVATION_RAD)
    picture = Image.fromarray(render(mesh, camera, _PANEL, floor_y=float(seen[:, 1].min()), look=_LOOK))
    draw = ImageDraw.Draw(picture)
    places = [tuple(place) for place in camera.project(posed.joints, _PANEL, _PANEL)[:, :2]]
    bones = [(parent, child) for child, parent in enumerate(posed.parents) if parent >= 0]
    for width, color in ((5, _RIM), (3, _BONE)):
        for parent, child in bones:
            draw.line((places[parent], places[child]), fill=color, width=width)
    for (x, y), parent in zip(places, posed.parents, strict=True):
        radius = 5 if parent < 0 else 3
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=_ROOT if parent < 0 else _JOINT, outline=_RIM)
    return np.asarray(picture)
