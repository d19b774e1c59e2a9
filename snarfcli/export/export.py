"""Exporting an avatar with its motions, and what is said about it afterwards."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snarfcli.errors import UserError
from snarfcli.export.character import (
    Character,
    CharacterOptions,
    build_character,
    character_surface,
    check_options,
)
from snarfcli.export.character_glb import write_character
from snarfcli.export.rig import Clip

if TYPE_CHECKING:
    from snarfcli.models.trained_field import TrainedField

__all__ = ["ClipReport", "ExportReport", "check_output", "export_character"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClipReport:
    """One clip of a file."""

    name: str
    frames: int
    frame_rate: float
    """Frames a second."""

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return (self.frames - 1) / self.frame_rate


@dataclass(frozen=True)
class ExportReport:
    """What was written, and how near it comes to the avatar's skinned surface. Distances are over all vertices and frames."""

    path: Path
    """The file."""
    num_bytes: int
    """Its size."""
    vertices: int
    triangles: int
    joints: int
    influences: int
    """Joints that move one vertex, at most."""
    truncation_mm: dict[str, float]
    """What few influences cost: max_mm, p99_mm, rms_mm."""
    morph_targets: int
    """Shapes for the pose-dependent shape."""
    morph_error_mm: dict[str, float]
    """What they leave of it."""
    shape_motion_mm: dict[str, float]
    """How far the pose-dependent shape is from its mean."""
    deviation_mm: dict[str, float]
    """All errors together: the posed character against the avatar's skinned surface with the same triangles."""
    clips: tuple[ClipReport, ...]
    skipped: tuple[tuple[str, int, str], ...] = ()
    """Clip, frame and reason where the shape could not be followed and is blended from the frames around."""

    @property
    def morph_share(self) -> float:
        """Share of the pose-dependent shape's variance that the morph targets explain, 0 to 1; 1 where there is none."""
        whole = self.shape_motion_mm["rms_mm"]
        return 1 - (self.morph_error_mm["rms_mm"] / whole) ** 2 if whole > 0 else 1.0

    def facts(self) -> dict[str, Any]:
        """Return everything but the path and the size, for records."""
        facts = {**asdict(self), "morph_share": round(self.morph_share, 4)}
        return {name: value for name, value in facts.items() if name not in ("path", "num_bytes")}

    def lines(self) -> list[str]:
        """Return the report for people."""
        moved, left = self.shape_motion_mm, self.morph_error_mm
        clips = ", ".join(f"{c.name} ({c.frames} frames, {c.seconds:.2f} s at {c.frame_rate:g})" for c in self.clips)
        return [
            f"mesh: {self.vertices} vertices, {self.triangles} triangles; {self.joints} joints",
            f"clips: {clips}",
            f"{self.influences} influences instead of {self.joints}: {_millimetres(self.truncation_mm)}",
            f"pose-dependent shape: moves vertices by {moved['rms_mm']:.2f} mm (rms), {moved['max_mm']:.2f} mm at most; "
            f"{self.morph_targets} morph targets explain {100 * self.morph_share:.1f} % and leave {_millimetres(left)}",
            f"all together, against the avatar's skinned surface: {_millimetres(self.deviation_mm)}",
        ]


def export_character(
    avatar: TrainedField,
    path: str | Path,
    clips: Sequence[Clip],
    options: CharacterOptions,
    *,
    name: str | None = None,
    overwrite: bool = False,
) -> ExportReport:
    """Write a rigged, animated character as `.glb`, whole or not at all.

    Args:
        avatar: with skinning weights.
        path: the file.
        clips: motions, at least one.
        options: what it may cost.
        name: of the mesh; the avatar's subject by default.
        overwrite: whether a file that is there already is replaced.

    Raises:
        UserError: a setting cannot be used, the file is there already, or the avatar has no weights or no surface.
    """
    check_options(options)
    path = Path(path)
    check_output(path, overwrite)
    if not clips:
        raise UserError("no motion to export; give at least one")
    surface = character_surface(avatar, options)
    character = build_character(avatar, surface, clips, options)
    report = _report(path, character, options)
    size = write_character(
        path,
        character,
        avatar.skeleton.names,
        avatar.skeleton.parents,
        name=name or str(avatar.facts.get("subject", "avatar")),
        weight_colors=options.weight_colors,
        facts={"snarf": report.facts()},
    )
    return _report(path, character, options, size)


def check_output(path: Path, overwrite: bool) -> None:
    """Refuse a file or folder that is there already.

    Raises:
        UserError: it is there, and is not to be replaced or is of another kind.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder; name a file")
    if path.exists() and not overwrite:
        raise UserError(f"{path} is there already; give overwrite=true to replace it, or output=FILE")


def _report(path: Path, character: Character, options: CharacterOptions, size: int = 0) -> ExportReport:
    """Return what is known of a character."""
    return ExportReport(
        path=path,
        num_bytes=size,
        vertices=len(character.mesh.vertices),
        triangles=len(character.mesh.faces),
        joints=len(character.bind),
        influences=options.influences,
        truncation_mm=character.truncation.facts(),
        morph_targets=len(character.shapes.targets),
        morph_error_mm=character.shape_error.facts(),
        shape_motion_mm=character.shape_motion.facts(),
        deviation_mm=character.deviation.facts(),
        clips=tuple(ClipReport(c.name, len(c.joints.rotation), c.frame_rate) for c in character.clips),
        skipped=tuple(character.skipped),
    )


def _millimetres(facts: dict[str, float]) -> str:
    """Return an error as text."""
    return f"{facts['rms_mm']:.2f} mm (rms), 99 % below {facts['p99_mm']:.2f} mm, {facts['max_mm']:.2f} mm at most"
