"""A moving avatar, frame by frame: extract, colour, write, draw. One mesh and one picture in memory at a time."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from snarfcli.export.meshes import read_mesh, weights_to_colors, write_mesh
from snarfcli.export.render import render
from snarfcli.export.stage import Stage
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import AvatarLike, posed_mesh
from snarfcli.progress import progress

__all__ = ["Animation", "FrameRecord"]

log = logging.getLogger(__name__)


@dataclass
class FrameRecord:
    """What became of one frame."""

    frame: int
    """Number in the motion."""
    file: str | None
    """Name of the mesh, if one was written."""
    extraction_s: float = 0.0
    rendering_s: float = 0.0
    vertices: int = 0
    points: int = 0
    """Points at which the field was evaluated; 0 for a frame that was there already."""
    components: int = 0
    """Connected surfaces; 0 for a frame that was there already."""
    problem: str | None = None
    """Why there is no surface."""


@dataclass
class Animation:
    """An avatar and a motion, and what to make of them."""

    avatar: AvatarLike
    name: str
    """What the progress calls the motion."""
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
    """Where the meshes go."""
    suffix: str | None
    """Format of the meshes, ply or obj; None writes none. Meshes that are there already are kept."""
    weights_from: Mesh | None = None
    """Canonical mesh whose weights colour the meshes of the field, see `field_surface`."""
    weight_colors: bool = False
    """Whether vertices are coloured by their skinning weights."""
    bone_transforms: np.ndarray | None = None
    """[T, J, 4, 4] canonical to posed, metres, where the poses do not say it all; None: those of the poses."""
    keep_share: float = 0.01
    """Connected surfaces with fewer faces than this share of the largest one's are dropped."""
    frames: list[FrameRecord] = field(default_factory=list)
    """What has been done so far."""

    def meshes(self, needed: bool = False) -> Iterator[tuple[FrameRecord, Mesh | None]]:
        """Extract, write and yield the mesh of each frame, or None where there is no surface.

        Args:
            needed: whether the mesh of a frame that is on disk already is read.
        """
        for index, number in enumerate(progress(self.numbers, desc=f"animate {self.name}", unit="frames")):
            start = time.perf_counter()
            file = self.folder / f"frame_{index:06d}.{self.suffix}" if self.suffix else None
            frame = FrameRecord(frame=number, file=file.name if file else None)
            mesh = None
            if file and file.exists():
                mesh = read_mesh(file) if needed else None
                frame.vertices = len(mesh.vertices) if mesh else 0
            else:
                mesh = self._extract(index, frame)
                if file and mesh is not None:
                    write_mesh(file, mesh)
            frame.extraction_s = round(time.perf_counter() - start, 4)
            self.frames.append(frame)
            yield frame, mesh

    def pictures(self, stage: Stage, size: tuple[int, int]) -> Iterator[np.ndarray]:
        """Yield a picture of each frame; the empty stage where there is no surface, so that the pace stays."""
        for frame, mesh in self.meshes(needed=True):
            start = time.perf_counter()
            picture = render(mesh, stage.camera, size, floor_y=stage.floor_y)
            frame.rendering_s = round(time.perf_counter() - start, 4)
            yield picture

    def _extract(self, index: int, frame: FrameRecord) -> Mesh | None:
        try:
            mesh = posed_mesh(
                self.avatar,
                torch.from_numpy(self.poses[index]).float(),
                torch.from_numpy(self.translation[index]).float(),
                self.resolution,
                surface=self.surface,
                weights_from=self.weights_from if self.weight_colors else None,
                keep_share=self.keep_share,
                transforms=None if self.bone_transforms is None else torch.from_numpy(self.bone_transforms[index]),
            )
        except (EmptySurface, FullSurface) as error:
            frame.problem, frame.file = str(error), None
            log.warning("frame %d: %s", frame.frame, error)
            return None
        frame.vertices = len(mesh.vertices)
        frame.points, frame.components = mesh.stats.points, mesh.stats.kept
        if mesh.stats.capped:
            log.warning("frame %d: the surface reaches the border of its box and was closed there", frame.frame)
        if self.weight_colors and mesh.weights is not None:
            mesh = replace(mesh, colors=weights_to_colors(mesh.weights))
        return mesh
