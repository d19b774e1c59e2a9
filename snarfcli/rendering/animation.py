"""An animation of an avatar, and the steps of one frame: extract, colour, write and draw its mesh."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from snarfcli.meshing.colors import weights_to_colors
from snarfcli.meshing.components import count_components
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.mesh_files import read_mesh, write_mesh
from snarfcli.meshing.posed import posed_mesh
from snarfcli.meshing.skinned import skinned_surface
from snarfcli.models.trained_field import TrainedField
from snarfcli.rendering.panels import Screen

__all__ = ["CONTENTS", "Animation", "FrameRecord", "GroundTruthMeshes", "place_canonical"]

CONTENTS = {
    "canonical": "canonical shape",
    "truth": "ground truth",
    "skinned": "skinned surface",
    "field": "field surface",
    "weights": "skinning weights",
}
"""Contents that can be shown beside the avatar, and their labels."""

_TRUTH_COLOR = (204, 178, 148)  # sRGB; clay, to tell it from the avatar


class GroundTruthMeshes(Protocol):
    """Floor-truth meshes by frame: vertices [V, 3], metres, and faces [F, 3]."""

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass
class FrameRecord:
    """Result of one frame."""

    frame: int
    """Number of the frame in the motion."""
    file: str | None
    """Name of the mesh file, if there is one."""
    extraction_s: float = 0.0
    rendering_s: float = 0.0
    vertices: int = 0
    points: int | None = 0
    """Points at which the field was evaluated; None for an existing mesh."""
    components: int | None = 0
    """Connected surfaces; None for an existing mesh that was not read."""
    is_capped: bool | None = False
    """Whether the surface reached the border of its box and was closed there; None for an existing mesh."""
    was_there: bool = False
    """Whether the mesh file existed already and was kept."""
    problem: str | None = None
    """Why there is no surface."""
    missing: list[str] = field(default_factory=list)
    """Contents that could not be shown beside the avatar, and why."""


@dataclass
class Animation:
    """An avatar, a motion, and how its meshes and pictures are made. It is pickled for worker processes."""

    avatar: TrainedField
    name: str
    """Name of the motion, for the progress."""
    poses: np.ndarray
    """[T, J, 3] axis-angle, radians, y up, global orientation included."""
    translation: np.ndarray
    """[T, 3] metres."""
    numbers: list[int]
    """T numbers of the frames in their motion."""
    surface: str
    """See `snarfcli.meshing.SURFACES`."""
    resolution: int
    """Cells along the longest side."""
    folder: Path
    """Folder of the meshes."""
    suffix: str | None
    """Format of the meshes, ply or obj; None writes none. Existing meshes are kept."""
    weights_from: Mesh | None = None
    """Canonical mesh whose weights colour the meshes of the field, see `field_surface`."""
    weight_colors: bool = False
    """Whether vertices are coloured by their skinning weights."""
    bone_transforms: np.ndarray | None = None
    """[T, J, 4, 4], canonical to posed, metres; needed where joints stretch, which poses cannot express."""
    keep_share: float = 0.01
    """Connected surfaces with fewer faces than this share of the largest one are dropped."""
    screen: Screen | None = None
    """How pictures are drawn; None draws none. Its contents are `avatar` and some of `CONTENTS`."""
    truth: GroundTruthMeshes | None = None
    """T meshes, if `truth` is on the screen."""
    frames: list[FrameRecord] = field(default_factory=list)
    """Records of the frames made so far."""

    def make(self, index: int) -> tuple[FrameRecord, np.ndarray | None]:
        """Extract, write and draw one frame; return its record, and its picture if there is a screen."""
        frame, shown = self.extract(index)
        if self.screen is None:
            return frame, None
        start = time.perf_counter()
        picture = self.screen.draw(index, shown)
        frame.rendering_s = round(time.perf_counter() - start, 4)
        return frame, picture

    def extract(self, index: int) -> tuple[FrameRecord, dict[str, Mesh | None]]:
        """Extract and write the mesh of one frame; return its record and the mesh per content, None for no surface."""
        start = time.perf_counter()
        file = self.folder / f"frame_{index:06d}.{self.suffix}" if self.suffix else None
        frame = FrameRecord(frame=self.numbers[index], file=file.name if file else None)
        mesh = None
        if file and file.exists():
            frame.was_there = True
            frame.points = frame.components = frame.is_capped = None
            mesh = read_mesh(file) if self.screen else None
            if mesh is not None:
                frame.vertices = len(mesh.vertices)
                frame.components = count_components(mesh.faces, len(mesh.vertices)) if self.surface == "field" else 0
        else:
            mesh = self._extract(index, frame)
            if file and mesh is not None:
                write_mesh(file, mesh)
        contents = self.screen.contents if self.screen else ()
        shown = {name: mesh if name == "avatar" else self._beside(name, index, frame) for name in contents}
        frame.extraction_s = round(time.perf_counter() - start, 4)
        return frame, shown

    def _posed(self, index: int, surface: str, weights_from: Mesh | None = None) -> Mesh:
        return posed_mesh(
            self.avatar,
            torch.from_numpy(self.poses[index]).float(),
            torch.from_numpy(self.translation[index]).float(),
            self.resolution,
            surface=surface,
            weights_from=weights_from,
            keep_share=self.keep_share,
            transforms=None if self.bone_transforms is None else torch.from_numpy(self.bone_transforms[index]),
        )

    def _extract(self, index: int, frame: FrameRecord) -> Mesh | None:
        try:
            mesh = self._posed(index, self.surface, self.weights_from if self.weight_colors else None)
        except (EmptySurface, FullSurface) as error:
            frame.problem, frame.file = str(error), None
            return None
        frame.vertices = len(mesh.vertices)
        if mesh.stats is not None:
            frame.points, frame.components, frame.is_capped = mesh.stats.points, mesh.stats.kept, mesh.stats.capped
        return _colored(mesh) if self.weight_colors else mesh

    def _beside(self, content: str, index: int, frame: FrameRecord) -> Mesh | None:
        """Return the mesh of one of `CONTENTS`; None if it has no surface."""
        try:
            if content == "truth":
                assert self.truth is not None
                vertices, faces = self.truth[index]
                return Mesh(vertices, faces, colors=np.tile(np.array(_TRUTH_COLOR, np.uint8), (len(vertices), 1)))
            if content == "canonical":
                mesh = self._canonical(index)
            else:
                lender = self.weights_from if self.weight_colors else None
                mesh = self._posed(index, "field" if content == "field" else "skinned", lender)
        except (EmptySurface, FullSurface) as error:
            frame.missing.append(f"{CONTENTS[content]}: {error}")
            return None
        return _colored(mesh) if content == "weights" or self.weight_colors else mesh

    def _canonical(self, index: int) -> Mesh:
        """Return the canonical mesh in the shape of one pose, at x = z = 0, in the mean direction of the body."""
        assert self.screen is not None
        surface = skinned_surface(self.avatar, self.resolution, self.keep_share)
        vertices = surface.canonical_vertices(torch.from_numpy(self.poses[index]).float())
        stage = self.screen.stage
        placed = place_canonical(vertices, surface.mesh, stage.heading_rad, stage.floor.height)
        return replace(surface.mesh, vertices=placed, normals=None)


def place_canonical(vertices: np.ndarray, mesh: Mesh, heading_rad: float, floor_y: float) -> np.ndarray:
    """Return canonical vertices [V, 3] turned and moved by what places `mesh` on the floor at x = z = 0."""
    lower, upper = mesh.bounds
    middle = (lower + upper) / 2
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    placed = (vertices - (middle[0], lower[1], middle[2])) @ turn.T + (0, floor_y, 0)
    return placed.astype(np.float32)


def _colored(mesh: Mesh) -> Mesh:
    """Return a mesh coloured by its weights, if it has any."""
    return mesh if mesh.weights is None else replace(mesh, colors=weights_to_colors(mesh.weights))
