"""Clips as folders of meshes, one file per frame: the skinned surface of the avatar, with all weights and its exact shape."""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from snarfcli.errors import UserError
from snarfcli.export.clips import Clip
from snarfcli.files import flush_to_disk
from snarfcli.meshing.colors import weights_to_colors
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.names import folder_names
from snarfcli.progress import progress

__all__ = ["atomic_folder", "check_folder", "tidy_folder", "write_sequence"]

log = logging.getLogger(__name__)

_TEMPORARY = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{8}\.(?P<kind>tmp|old)")
_FRAMES = re.compile(r"frame_\d{6}\.(ply|obj)|export\.json")


def check_folder(folder: Path, overwrite: bool, ours: re.Pattern[str] = _FRAMES) -> Path:
    """Check that a folder can be written: it is empty, or contains only files of an export and `overwrite` is True.

    Args:
        folder: the folder.
        overwrite: whether files of an export are replaced.
        ours: names of the files of an export; by default those of frames.

    Returns:
        The folder with links resolved: it is replaced as a whole, and a link to it stays.

    Raises:
        UserError: it cannot or must not be replaced.
    """
    try:
        place = folder.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise UserError(
            f"{folder}: wanted a folder, got a link that cannot be resolved ({error}); give output=FOLDER"
        ) from None
    if place.exists() and not place.is_dir():
        raise UserError(f"{folder}: wanted a folder, got a file; give output=FOLDER")
    is_fixed = place.is_dir() and (os.path.ismount(place) or not os.access(place.parent, os.W_OK))
    if is_fixed or (place.is_dir() and Path.cwd().is_relative_to(place)):
        raise UserError(
            f"{folder}: wanted a folder that can be replaced as a whole, got a disk, a folder in a read-only one, or a parent "
            "of the current folder; give output=FOLDER in it"
        )
    there = [path for path in place.rglob("*") if path.is_symlink() or not path.is_dir()] if place.is_dir() else []
    if there and not overwrite:
        raise UserError(f"{folder} contains {there[0].name} already; give overwrite=true to replace it, or output=FOLDER")
    foreign = [path for path in there if path.is_symlink() or not ours.fullmatch(path.name)]
    if foreign:
        raise UserError(f"{folder}: wanted only files of such an export, got {foreign[0].name}; give output=FOLDER")
    return place


def tidy_folder(folder: Path) -> None:
    """Bring back the old content of a folder, and delete the new one, after `atomic_folder` was killed.

    Only the holder of the folder's lock may do so.
    """
    for path in sorted(folder.parent.iterdir()) if folder.parent.is_dir() else ():
        match = _TEMPORARY.fullmatch(path.name)
        if match is None or match["name"] != folder.name or not path.is_dir():
            continue
        if match["kind"] == "old" and not folder.exists():
            path.rename(folder)
        else:
            shutil.rmtree(path, ignore_errors=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `folder` when the block succeeds, and is deleted when it fails.

    Args:
        folder: result of `check_folder`; its old content is moved aside first and deleted last.

    Raises:
        UserError: it cannot be replaced; the old content is kept, and the message names the folder of the new files.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    temporary, aside = (folder.with_name(f".{folder.name}.{token}.{kind}") for kind in ("tmp", "old"))
    temporary.mkdir()
    try:
        yield temporary
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    try:
        if folder.exists():
            folder.rename(aside)
        temporary.rename(folder)
        flush_to_disk(folder.parent)
    except OSError as error:
        if aside.exists() and not folder.exists():
            aside.rename(folder)
        raise UserError(f"{folder} could not be replaced ({error.strerror}); the new files are in {temporary}") from None
    shutil.rmtree(aside, ignore_errors=True)


def write_sequence(
    folder: Path, surface: SkinnedSurface, clips: Sequence[Clip], suffix: str, *, weight_colors: bool = False
) -> list[tuple[str, int, str]]:
    """Write `frame_000000.ply` and so on into a folder; several clips get one subfolder each.

    Args:
        folder: existing folder.
        surface: skinned surface of the avatar.
        clips: motions, at least one.
        suffix: ply or obj.
        weight_colors: whether vertices are coloured by their weights.

    Returns:
        Clip, frame and reason of frames without a surface; their numbers are left out.
    """
    skipped = []
    assert surface.mesh.weights is not None
    colors = weights_to_colors(surface.mesh.weights) if weight_colors else None
    for name, clip in zip(folder_names(clip.motion.name for clip in clips), clips, strict=True):
        place = folder
        if len(clips) > 1:
            place = folder / name
            place.mkdir()
        motion = clip.motion
        for frame in progress(range(motion.num_frames), desc=f"export {name}", unit="frames"):
            pose, translation = (torch.from_numpy(part[frame]).float() for part in (motion.poses, motion.translation))
            transforms = None if clip.bone_transforms is None else torch.as_tensor(clip.bone_transforms[frame]).float()
            try:
                mesh = surface.posed(pose, translation, transforms)
            except (EmptySurface, FullSurface) as error:
                skipped.append((name, frame, str(error)))
                continue
            MESH_WRITERS[suffix](place / f"frame_{frame:06d}.{suffix}", replace(mesh, colors=colors))
        flush_to_disk(place)
    return skipped
