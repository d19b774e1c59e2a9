"""Export an avatar and its motions as a character file, and report its size and accuracy."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.export.character import Character, CharacterOptions, check_options
from snarfcli.export.character_build import build_character
from snarfcli.export.character_glb import write_character
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip
from snarfcli.models.trained_field import TrainedField
from snarfcli.texts import counted

__all__ = ["ClipReport", "ExportReport", "check_output", "export_character", "report_of"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClipReport:
    """One clip of a file."""

    name: str
    frames: int
    frame_rate: float
    """Frames per second."""

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last."""
        return (self.frames - 1) / self.frame_rate


@dataclass(frozen=True)
class ExportReport:
    """Size of a character file, and its distances from the skinned surface of the avatar, over all vertices and frames."""

    path: Path
    """The file."""
    num_bytes: int
    """Size of the file."""
    vertices: int
    triangles: int
    joints: int
    influences: int
    """Maximum number of joints per vertex."""
    truncation_mm: dict[str, float]
    """Error of the reduced number of influences: max_mm, p99_mm, rms_mm."""
    morph_targets: int
    """Number of morph targets for the pose-dependent shape."""
    morph_error_mm: dict[str, float]
    """Error of the morph targets."""
    shape_motion_mm: dict[str, float]
    """Distance of the pose-dependent shape from its mean."""
    deviation_mm: dict[str, float]
    """Total error: the posed character against the skinned surface of the avatar with the same triangles."""
    clips: tuple[ClipReport, ...]
    skipped: tuple[tuple[str, int, str], ...] = ()
    """Clip, frame and reason of frames whose shape could not be followed; it is interpolated from the frames around."""

    @property
    def morph_share(self) -> float:
        """Share of the variance of the pose-dependent shape that the morph targets explain, 0 to 1; 1 for a constant shape."""
        whole = self.shape_motion_mm["rms_mm"]
        return 1 - (self.morph_error_mm["rms_mm"] / whole) ** 2 if whole > 0 else 1.0

    def facts(self) -> dict[str, Any]:
        """Return all fields except the path and the size, for records."""
        facts = {**asdict(self), "morph_share": round(self.morph_share, 4)}
        return {name: value for name, value in facts.items() if name not in ("path", "num_bytes")}

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        moved, left = self.shape_motion_mm, self.morph_error_mm
        clips = ", ".join(f"{c.name} ({counted(c.frames, 'frame')}, {c.seconds:.2f} s at {c.frame_rate:g})" for c in self.clips)
        return [
            f"mesh: {self.vertices} vertices, {self.triangles} triangles; {counted(self.joints, 'joint')}",
            f"clips: {clips}",
            f"{counted(self.influences, 'influence')} instead of {self.joints}: {_millimetres(self.truncation_mm)}",
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
    joint_names: Sequence[str] | None = None,
    overwrite: bool = False,
) -> ExportReport:
    """Write a rigged, animated character as `.glb`, whole or not at all.

    Args:
        avatar: an avatar with skinning weights.
        path: the file.
        clips: motions, at least one.
        options: limits on the size of the character.
        name: name of the mesh; by default the subject of the avatar.
        joint_names: names of the joints; by default those of the avatar's skeleton.
        overwrite: whether an existing file is replaced.

    Raises:
        UserError: an option is out of range, the file exists, or the avatar has no weights or no surface.
    """
    check_options(options)
    path = Path(path)
    check_output(path, overwrite)
    if not clips:
        raise UserError("clips: wanted at least one motion to export, got none; give a motion")
    surface = character_surface(avatar, options)
    character = build_character(avatar, surface, clips, options)
    report = report_of(path, character, options)
    size = write_character(
        path,
        character,
        joint_names or avatar.skeleton.names,
        avatar.skeleton.parents,
        name=name or str(avatar.facts.get("subject", "avatar")),
        weight_colors=options.weight_colors,
        facts={"snarf": report.facts()},
    )
    return report_of(path, character, options, size)


def check_output(path: Path, overwrite: bool) -> None:
    """Check that a file can be written.

    Raises:
        UserError: the path is a folder, or it exists and `overwrite` is False.
    """
    if path.is_dir():
        raise UserError(f"{path}: wanted a file, got a folder; give the name of a file")
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists already; give overwrite=true to replace it, or output=FILE")


def report_of(path: Path, character: Character, options: CharacterOptions, size: int = 0) -> ExportReport:
    """Return the report of a character in a file of `size` bytes."""
    return ExportReport(
        path=path,
        num_bytes=size,
        vertices=len(character.mesh.vertices),
        triangles=len(character.mesh.faces),
        joints=len(character.bind),
        influences=options.influences,
        truncation_mm=character.errors.truncation.facts(),
        morph_targets=len(character.shapes.targets),
        morph_error_mm=character.errors.shape_error.facts(),
        shape_motion_mm=character.errors.shape_motion.facts(),
        deviation_mm=character.errors.deviation.facts(),
        clips=tuple(ClipReport(c.name, len(c.joints.rotation), c.frame_rate) for c in character.clips),
        skipped=tuple(character.skipped),
    )


def _millimetres(facts: dict[str, float]) -> str:
    """Return an error as text, in millimetres."""
    return f"{facts['rms_mm']:.2f} mm (rms), 99 % below {facts['p99_mm']:.2f} mm, {facts['max_mm']:.2f} mm at most"
