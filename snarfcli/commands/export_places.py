"""Where `snarf export` writes, and the motions that it writes."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from snarfcli.avatar import Avatar
from snarfcli.commands.export_settings import FOLDER_FORMATS, FORMATS, ExportConfig
from snarfcli.commands.selection import BUILTIN_MOTIONS, select_motion
from snarfcli.errors import UserError
from snarfcli.export.character import CharacterOptions
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip, on_ground
from snarfcli.export.export import check_output
from snarfcli.export.sequence import check_folder, tidy_folder
from snarfcli.files import atomic_path, read_json, remove_temporaries, write_json
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.models.pretrained import CARD_FILE, CONFIG_FILE, TENSORS_FILE
from snarfcli.names import folder_name, folder_names
from snarfcli.output_locks import clear_killed, hold_output

__all__ = [
    "check_place",
    "clip_files",
    "default_place",
    "read_clips",
    "record_file",
    "subject_name",
    "wanted_motions",
    "write_record",
    "writing",
]

log = logging.getLogger(__name__)

_GROUND_RESOLUTION = 128
_RECORD = "export.json"
_PRETRAINED = re.compile("|".join(map(re.escape, (CARD_FILE, CONFIG_FILE, TENSORS_FILE))))


def subject_name(config: ExportConfig, avatar: Avatar) -> str:
    """Return the subject as a valid file name. (With ckpt=FILE only the avatar knows the subject.)"""
    return folder_name(str(avatar.facts.get("subject") or config.subject), "avatar")


def default_place(config: ExportConfig, folder: Path, subject: str) -> Path:
    """Return the default output: a file, or a folder for meshes and pretrained avatars."""
    joint = "_" if config.format in FOLDER_FORMATS else "."
    return folder / "export" / f"{subject}{joint}{config.format}"


def check_place(config: ExportConfig, output: Path) -> Path:
    """Check that the output does not exist (or may be replaced) and has the suffix of the format; return its path.

    What an interrupted export has left may be replaced; its record says so.

    Raises:
        UserError: it cannot be written.
    """
    clear_killed(output)
    if config.format in MESH_WRITERS:
        return check_folder(output, config.overwrite)
    if config.format == "pretrained":
        overwrite = _may_replace(config, output)
        place = check_folder(output, overwrite, _PRETRAINED)
        check_output(record_file(config, place), overwrite)
        return place
    suffix = output.suffix.lower().lstrip(".")
    if suffix != config.format:
        hint = f"give format={suffix}, or " if suffix in FORMATS and suffix not in FOLDER_FORMATS else ""
        raise UserError(f"output: wanted a name ending in .{config.format}, got {output}; {hint}give another name")
    overwrite = _may_replace(config, output)
    check_output(output, overwrite)
    check_output(record_file(config, output), overwrite)
    return output


def record_file(config: ExportConfig, output: Path) -> Path:
    """Return the file of the record: in the folder of meshes, or beside the output: it names paths, and is not passed on."""
    if config.format in MESH_WRITERS:
        return output / _RECORD
    name = output.name if config.format == "pretrained" else f"{output.stem}_{output.suffix[1:]}"
    return output.with_name(f"{name}.json")


def clip_files(config: ExportConfig, output: Path, names: Sequence[str], suffix: str) -> list[Path]:
    """Return the files of clips, checked as the output is: the output of a single clip, else NAME_<clip>.suffix beside it.

    Raises:
        UserError: one cannot be written.
    """
    if len(names) == 1:
        files = [output.with_suffix(f".{suffix}")]
    else:
        files = [output.with_name(f"{output.stem}_{name}.{suffix}") for name in folder_names(names)]
    for file in files:
        check_output(file, _may_replace(config, output))
    return files


def _may_replace(config: ExportConfig, output: Path) -> bool:
    """Return whether existing output may be replaced."""
    return config.overwrite or _is_unfinished(record_file(config, output))


def _is_unfinished(record: Path) -> bool:
    try:
        content = read_json(record, "record of an export")
    except UserError:
        return False
    return isinstance(content, dict) and content.get("complete") is False


@contextmanager
def writing(config: ExportConfig, output: Path, files: Sequence[Path] = ()) -> Iterator[None]:
    """Hold the lock of the output while the block writes it, and its record.

    Until the record is written, an unfinished one stands for it, by which the same command can be run again after a crash.
    (Meshes need none, since their folder appears as a whole.)

    Args:
        config: settings of the export.
        output: the file, or the folder of meshes.
        files: further files, such as those of clips.

    Raises:
        UserError: another process is writing the output, or has written it meanwhile.
    """
    with hold_output(output, "snarf export", wait=config.wait):
        if config.format in MESH_WRITERS:
            tidy_folder(output)
            check_place(config, output)
            yield
            return
        if config.format == "pretrained":
            tidy_folder(output)
        check_place(config, output)
        record = record_file(config, output)
        places = (output, *files)
        for place in (*places, record):
            remove_temporaries(place.parent, place.name)
        before, old = _identities(places), record.read_bytes() if record.exists() else None
        write_json(record, {"complete": False, "config": asdict(config)})
        try:
            yield
        except BaseException:
            if _identities(places) == before:  # nothing has been written
                _put_back(record, old)
            raise


def _put_back(record: Path, content: bytes | None) -> None:
    if content is None:
        record.unlink(missing_ok=True)
        return
    with atomic_path(record) as temporary:
        temporary.write_bytes(content)


def write_record(config: ExportConfig, folder_or_file: Path, facts: dict[str, Any]) -> None:
    """Write the record of an export, which completes it."""
    write_json(record_file(config, folder_or_file), {"complete": True, "config": asdict(config), **facts})


def _identities(files: Sequence[Path]) -> list[tuple[int, ...] | None]:
    """Return what tells whether files have been replaced."""
    stats = [file.stat() if file.exists() else None for file in files]
    return [None if stat is None else (stat.st_ino, stat.st_mtime_ns, stat.st_size) for stat in stats]


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
