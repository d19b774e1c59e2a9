"""The output folder of `snarf animate`: continued with the same settings, rejected with other settings."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from snarfcli import names
from snarfcli.commands.animate_settings import AnimateConfig
from snarfcli.commands.selection import SelectedMotion
from snarfcli.descriptions import DescriptionError, check_plain
from snarfcli.errors import UserError
from snarfcli.files import read_json, remove_temporaries, write_json
from snarfcli.texts import one_line

__all__ = ["POSTER", "RECORD", "VIDEO", "check_record", "folder_name", "frame_settings", "prepare_folder"]

RECORD = "animation.json"
VIDEO = "video.mp4"
POSTER = "poster.png"


def folder_name(name: str) -> str:
    """Return the name of a motion as a valid folder name."""
    return names.folder_name(name, "motion")


def frame_settings(config: AnimateConfig, avatar: Path, chosen: SelectedMotion) -> dict[str, Any]:
    """Return the settings that the frames depend on. Frames of different settings are never mixed."""
    # Of the frame range only start and step, so that more frames of the same motion can be added later.
    whole = chosen.whole
    digest = hashlib.sha256(whole.poses.tobytes() + whole.translation.tobytes())
    return {
        "avatar_sha256": hashlib.sha256(avatar.read_bytes()).hexdigest(),
        "motion_sha256": digest.hexdigest(),
        "start": chosen.first,
        "step": config.step,
        "frame_rate": config.frame_rate,
        "in_place": config.in_place,
        "surface": config.surface,
        "resolution": config.resolution,
        "keep_share": config.keep_share,
        "format": config.format,
        "weight_colors": config.weight_colors,
    }


def prepare_folder(folder: Path, settings: dict[str, Any], overwrite: bool) -> None:
    """Prepare the folder: keep frames of the same settings, or start again with `overwrite`.

    Raises:
        UserError: it has frames of other settings, or files of unknown origin, and `overwrite` is false.
    """
    if overwrite or not check_record(folder, settings):
        there = [*folder.glob("frame_*.ply"), *folder.glob("frame_*.obj"), *folder.glob(VIDEO), *folder.glob(POSTER)]
        if there and not overwrite:  # without a record their origin is unknown
            raise UserError(
                f"{folder} has {there[0].name} of unknown origin; give overwrite=true to replace it, or output=FOLDER"
            )
        for stale in there:
            stale.unlink(missing_ok=True)
    remove_temporaries(folder)
    write_json(folder / RECORD, {"complete": False, "settings": settings})


def check_record(folder: Path, settings: dict[str, Any]) -> bool:
    """Check that the frames in a folder were made with the same settings; return whether it has a record of any.

    Raises:
        UserError: they were made with other settings, or the record is damaged.
    """
    record = folder / RECORD
    if not record.exists():
        return False
    content = read_json(record, "record of an animation")
    old = content.get("settings") if isinstance(content, dict) else None
    if not isinstance(old, dict) or not _is_plain(old):
        raise UserError(f"{record} is not the record of an animation; give overwrite=true to replace it, or output=FOLDER")
    changed = [name for name, value in settings.items() if old.get(name) != value]
    if changed:
        others = [name for name in changed if "sha256" not in name]
        what = ", ".join(f"{name} {one_line(str(old.get(name)), 60)} (now {settings[name]})" for name in others)
        what = what or ("another avatar" if "avatar_sha256" in changed else "another motion")
        raise UserError(f"{folder} has frames made with {what}; give overwrite=true to replace them, or output=FOLDER")
    return True


def _is_plain(content: Any) -> bool:
    """Return whether content is plain data."""
    try:
        check_plain(content, "settings")
    except DescriptionError:
        return False
    return True
