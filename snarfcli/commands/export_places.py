"""Where `snarf export` writes, and the motions that it writes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from snarfcli.avatar import Avatar
from snarfcli.commands.export_settings import FORMATS, ExportConfig
from snarfcli.commands.selection import BUILTIN_MOTIONS, select_motion
from snarfcli.errors import UserError
from snarfcli.export.character import CharacterOptions
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip, on_ground
from snarfcli.export.export import check_output
from snarfcli.export.sequence import check_folder
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.names import folder_name, folder_names

__all__ = ["check_place", "clip_files", "default_place", "read_clips", "record_file", "subject_name", "wanted_motions"]

log = logging.getLogger(__name__)

_GROUND_RESOLUTION = 128
_RECORD = "export.json"


def subject_name(config: ExportConfig, avatar: Avatar) -> str:
    """Return the subject as a valid file name. (With ckpt=FILE only the avatar knows the subject.)"""
    return folder_name(str(avatar.facts.get("subject") or config.subject), "avatar")


def default_place(config: ExportConfig, folder: Path, subject: str) -> Path:
    """Return the default output: a file, or a folder for meshes."""
    joint = "_" if config.format in MESH_WRITERS else "."
    return folder / "export" / f"{subject}{joint}{config.format}"


def check_place(config: ExportConfig, output: Path) -> Path:
    """Check that the output does not exist (or may be replaced) and has the suffix of the format; return its path.

    Raises:
        UserError: it cannot be written.
    """
    if config.format in MESH_WRITERS:
        return check_folder(output, config.overwrite)
    suffix = output.suffix.lower().lstrip(".")
    if suffix != config.format:
        hint = f"give format={suffix}, or " if suffix in FORMATS and suffix not in MESH_WRITERS else ""
        raise UserError(f"output: wanted a name ending in .{config.format}, got {output}; {hint}give another name")
    check_output(output, config.overwrite)
    check_output(record_file(config, output), config.overwrite)
    return output


def record_file(config: ExportConfig, output: Path) -> Path:
    """Return the file of the record: in the folder of meshes, or beside the output file."""
    return output / _RECORD if config.format in MESH_WRITERS else output.with_name(f"{output.stem}_{output.suffix[1:]}.json")


def clip_files(config: ExportConfig, output: Path, names: Sequence[str], suffix: str) -> list[Path]:
    """Return the files of clips, checked as the output is: the output of a single clip, else NAME_<clip>.suffix beside it.

    Raises:
        UserError: one cannot be written.
    """
    if len(names) == 1:
        return [output.with_suffix(f".{suffix}")]
    files = [output.with_name(f"{output.stem}_{name}.{suffix}") for name in folder_names(names)]
    for file in files:
        check_output(file, config.overwrite)
    return files


def wanted_motions(config: ExportConfig) -> list[tuple[str | None, str | None]]:
    """Return the pose file or the built-in motion of each clip; both are None for the default motion."""
    wanted: list[tuple[str | None, str | None]] = [(pose, None) for pose in config.pose or ()]
    wanted += [(None, motion) for motion in config.motion or ()]
    return wanted or [(None, None)]


def read_clips(config: ExportConfig, avatar: Avatar) -> list[Clip]:
    """Read all motions, and move those to the ground for which `height` says so.

    Raises:
        UserError: a motion cannot be read, or the avatar has no surface.
    """
    clips = []
    for pose, motion in wanted_motions(config):
        chosen = select_motion(config, config, avatar.skeleton, pose, motion)
        clip = Clip(chosen.motion, chosen.bone_transforms)
        is_builtin = pose is None and clip.bone_transforms is None and clip.motion.name in BUILTIN_MOTIONS
        if config.height == "ground" or (config.height == "auto" and is_builtin):
            rough = CharacterOptions(triangles=None, resolution=min(_GROUND_RESOLUTION, config.resolution))
            clip, up = on_ground(character_surface(avatar, rough).mesh, avatar.skeleton, clip)
            log.info("%s stands on y = 0: moved by %.3f m", clip.motion.name, up)
        clips.append(clip)
    return clips
