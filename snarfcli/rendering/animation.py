"""A moving avatar, frame by frame: extract, colour, write, draw. One mesh and one picture in memory at a time."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from snarfcli.meshing.colors import weights_to_colors
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.mesh_files import read_mesh, write_mesh
from snarfcli.meshing.posed import posed_mesh
from snarfcli.meshing.skinned import skinned_surface
from snarfcli.models.trained_field import TrainedField
from snarfcli.parallel import Worker, interrupts_held_back
from snarfcli.progress import progress
from snarfcli.rendering.drawers import Drawer
from snarfcli.rendering.panels import Screen

__all__ = ["CONTENTS", "Animation", "FrameRecord", "Meshes"]

log = logging.getLogger(__name__)

CONTENTS = {
    "canonical": "canonical shape",
    "truth": "ground truth",
    "skinned": "skinned surface",
    "field": "field surface",
    "weights": "skinning weights",
}
"""What can be shown beside the avatar, and what is written below it."""

_TRUTH_COLOR = (204, 178, 148)  # sRGB; clay, so that nobody takes it for the avatar


class Meshes(Protocol):
    """Meshes by number: vertices [V, 3], metres, and faces [F, 3]."""

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]: ...


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
    is_capped: bool = False
    """Whether the surface reached the border of its box and was closed there."""
    was_there: bool = False
    """Whether the mesh was there already and was kept."""
    problem: str | None = None
    """Why there is no surface."""
    missing: list[str] = field(default_factory=list)
    """What could not be shown beside it, and why."""


@dataclass
class Animation:
    """An avatar and a motion, and what to make of them. It travels to worker processes as it is."""

    avatar: TrainedField
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
    screen: Screen | None = None
    """How pictures are drawn; None draws none. Its contents are `avatar` and some of `CONTENTS`."""
    truth: Meshes | None = None
    """T meshes, if `truth` is on the screen."""
    frames: list[FrameRecord] = field(default_factory=list)
    """What has been done so far."""

    def pictures(self, processes: int = 1, threads: int = 1, *, extracts_here: bool = False) -> Iterator[np.ndarray | None]:
        """Extract and write the mesh of each frame, and yield its picture, or None without a screen.

        Where there is no surface, the picture is that of the empty stage, so that the pace stays.

        Args:
            processes: how many make frames at the same time; 1 works in this one.
            threads: threads of tensor work in each of several.
            extracts_here: whether this process extracts all meshes, since it has the GPU, and the others only draw.

        Raises:
            UserError: a process ended without a word, as when the system kills it for want of memory.
        """
        count = len(self.numbers)
        if processes == 1 or (extracts_here and self.screen is None):
            made = (self.make(index) for index in range(count))
        elif extracts_here:
            made = _drawn_elsewhere(self, min(processes, count))
        else:
            made = _made_elsewhere(replace(self, frames=[]), min(processes, count), threads)
        with contextlib.closing(made):
            shown = progress(zip(range(count), made, strict=True), total=count, desc=f"animate {self.name}", unit="frames")
            for _, (frame, picture) in shown:
                if frame.problem:
                    log.warning("frame %d: %s", frame.frame, frame.problem)
                for text in frame.missing:
                    log.warning("frame %d, beside: %s", frame.frame, text)
                if frame.is_capped:
                    log.warning("frame %d: the surface reaches the border of its box and was closed there", frame.frame)
                self.frames.append(frame)
                yield picture

    def make(self, index: int) -> tuple[FrameRecord, np.ndarray | None]:
        """Make one frame: its record, and its picture if there is a screen. The mesh is on disk then, if it is written."""
        frame, shown = self.extract(index)
        if self.screen is None:
            return frame, None
        start = time.perf_counter()
        picture = self.screen.draw(index, shown)
        frame.rendering_s = round(time.perf_counter() - start, 4)
        return frame, picture

    def extract(self, index: int) -> tuple[FrameRecord, dict[str, Mesh | None]]:
        """Extract and write the mesh of one frame; return its record, and what the screen shows, None for no surface."""
        start = time.perf_counter()
        file = self.folder / f"frame_{index:06d}.{self.suffix}" if self.suffix else None
        frame = FrameRecord(frame=self.numbers[index], file=file.name if file else None)
        mesh = None
        if file and file.exists():
            frame.was_there = True
            mesh = read_mesh(file) if self.screen else None
            frame.vertices = len(mesh.vertices) if mesh else 0
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
        """Return what is shown beside the avatar, as one of `CONTENTS`; None if it has no surface."""
        try:
            if content == "truth":
                assert self.truth is not None
                vertices, faces = self.truth[index]
                return Mesh(vertices, faces, colors=np.tile(np.uint8(_TRUTH_COLOR), (len(vertices), 1)))
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
        """Return the canonical mesh in the shape of one pose, over x = z = 0, facing where the body mostly does."""
        assert self.screen is not None
        surface = skinned_surface(self.avatar, self.resolution, self.keep_share)
        vertices = surface.canonical_vertices(torch.from_numpy(self.poses[index]).float())
        stage = self.screen.stage
        placed = place_canonical(vertices, surface.mesh, stage.heading_rad, stage.ground.height)
        return replace(surface.mesh, vertices=placed, normals=None)


def place_canonical(vertices: np.ndarray, mesh: Mesh, heading_rad: float, floor_y: float) -> np.ndarray:
    """Return canonical vertices [V, 3] turned and moved so that `mesh` would stand over x = z = 0 on the floor."""
    lower, upper = mesh.bounds
    middle = (lower + upper) / 2
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    placed = (vertices - (middle[0], lower[1], middle[2])) @ turn.T + (0, floor_y, 0)
    return placed.astype(np.float32)


def _colored(mesh: Mesh) -> Mesh:
    """Return a mesh in the colours of its weights, if it has any."""
    return mesh if mesh.weights is None else replace(mesh, colors=weights_to_colors(mesh.weights))


def _made_elsewhere(animation: Animation, processes: int, threads: int) -> Iterator[tuple[FrameRecord, np.ndarray | None]]:
    """Make the frames on several processes and yield them in order.

    Of P processes each makes every P-th frame. One that is ahead waits until its frame is asked for, so no more than two
    pictures a process are in memory.
    """
    workers: list[Worker] = []
    try:
        for first in range(processes):
            with interrupts_held_back():
                task = (animation, threads, range(first, len(animation.numbers), processes))
                workers.append(Worker(_make_some, task, f"processes={max(1, processes // 2)}"))
        for index in range(len(animation.numbers)):
            has_item, item = workers[index % processes].receive()
            assert has_item
            yield item
    finally:
        _end_all(workers)


def _drawn_elsewhere(animation: Animation, processes: int) -> Iterator[tuple[FrameRecord, np.ndarray | None]]:
    """Extract all meshes here, draw them on several processes, and yield the frames in order; each process has one at most."""
    assert animation.screen is not None
    drawers: list[Drawer] = []
    waiting: deque[tuple[FrameRecord, Drawer]] = deque()

    def oldest() -> tuple[FrameRecord, np.ndarray]:
        frame, drawer = waiting.popleft()
        picture, seconds = drawer.take()
        frame.rendering_s = round(seconds, 4)
        return frame, picture

    try:
        for _ in range(processes):
            with interrupts_held_back():
                drawers.append(Drawer(animation.screen))
        for index in range(len(animation.numbers)):
            frame, shown = animation.extract(index)
            if len(waiting) == processes:
                yield oldest()
            drawers[index % processes].begin(index, shown)
            waiting.append((frame, drawers[index % processes]))
        while waiting:
            yield oldest()
    finally:
        _end_all(drawers)


def _end_all(workers: Sequence[Worker | Drawer]) -> None:
    """End processes all at once: each comes to its end only when it leaves native code."""
    endings = [threading.Thread(target=worker.end) for worker in workers]
    for ending in endings:
        ending.start()
    for ending in endings:
        ending.join()


def _make_some(animation: Animation, threads: int, numbers: Sequence[int]) -> Iterator[tuple[FrameRecord, np.ndarray | None]]:
    """Make some frames in a worker process."""
    # Whoever started it ends it so; leaving in order takes a half-written file along.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    torch.set_num_threads(threads)
    try:
        for index in numbers:
            yield animation.make(index)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # nothing is half-written any more
