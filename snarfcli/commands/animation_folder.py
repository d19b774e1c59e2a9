"""The folder that `snarf animate` writes to: kept when the same command goes on, refused to other settings."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from snarfcli import names
from snarfcli.commands.animate_settings import AnimateConfig
from snarfcli.commands.selection import SelectedMotion
from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json

__all__ = ["POSTER", "RECORD", "VIDEO", "folder_name", "frame_settings", "prepare_folder"]

RECORD = "animation.json"
VIDEO = "video.mp4"
POSTER = "poster.png"


def folder_name(name: str) -> str:
    """Return a motion's name as a folder's."""
    return names.folder_name(name, "motion")


def frame_settings(config: AnimateConfig, avatar: Path, chosen: SelectedMotion) -> dict[str, Any]:
    """Return what the frames depend on: frames of other settings must not be mixed with them."""
    # Of the frames, only which the first one is and how far they are apart: more of the same motion can be made later.
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
    """Make the folder ready: keep frames of the same settings, refuse others, or start again.

    Raises:
        UserError: it holds other frames, or files of unknown origin, and `overwrite` is false.
    """
    record = folder / RECORD
    old = None
    if record.exists() and not overwrite:
        content = read_json(record, "record of an animation")
        old = content.get("settings") if isinstance(content, dict) else None
        if not isinstance(old, dict):
            raise UserError(f"{record} is no record of an animation; give overwrite=true to replace it, or output=FOLDER")
    if old is not None:
        changed = [name for name, value in settings.items() if old.get(name) != value]
        if changed:
            what = ", ".join(f"{name} {old.get(name)} (now {settings[name]})" for name in changed if "sha256" not in name)
            what = what or ("another avatar" if "avatar_sha256" in changed else "another motion")
            raise UserError(f"{folder} holds frames made with {what}; give overwrite=true to replace them, or output=FOLDER")
    else:
        there = [*folder.glob("frame_*.ply"), *folder.glob("frame_*.obj"), *folder.glob(VIDEO), *folder.glob(POSTER)]
        if there and not overwrite:  # without a record they are somebody else's
            raise UserError(
                f"{folder} holds {there[0].name} of unknown origin; give overwrite=true to replace it, or output=FOLDER"
            )
        for stale in there:
            stale.unlink(missing_ok=True)
    for half in (*folder.glob(".frame_*.tmp.*"), *folder.glob(".video.*.tmp.mp4")):
        half.unlink(missing_ok=True)  # of a process that was killed
    write_json(record, {"complete": False, "settings": settings})
