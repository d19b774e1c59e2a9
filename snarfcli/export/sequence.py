"""Clips as folders of meshes, a file a frame: the avatar's skinned surface itself, with all weights and its own shape."""

from __future__ import annotations

import logging
import re
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from snarfcli.errors import UserError
from snarfcli.export.clips import Clip
from snarfcli.meshing.colors import weights_to_colors
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.names import folder_names
from snarfcli.progress import progress

if TYPE_CHECKING:
    from snarfcli.meshing.skinned import SkinnedSurface

__all__ = ["atomic_folder", "check_folder", "write_sequence"]

log = logging.getLogger(__name__)

_OURS = re.compile(r"frame_\d{6}\.(ply|obj)|export\.json")


def check_folder(folder: Path, overwrite: bool) -> Path:
    """Refuse a folder that holds something, unless it may be replaced and holds nothing but frames.

    Returns:
        The folder itself, links followed: it is replaced as a whole, and a link to it stays.

    Raises:
        UserError: it must stay as it is, or cannot be replaced.
    """
    try:
        place = folder.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise UserError(f"{folder} cannot be followed ({error}); give output=FOLDER") from None
    if place.exists() and not place.is_dir():
        raise UserError(f"{folder} is a file, not a folder; give output=FOLDER")
    if place.is_dir() and (Path.cwd().is_relative_to(place) or place.is_mount()):
        raise UserError(f"{folder} holds the current folder or is a disk, and is replaced as a whole; give output=FOLDER in it")
    there = [path for path in place.rglob("*") if path.is_symlink() or not path.is_dir()] if place.is_dir() else []
    if there and not overwrite:
        raise UserError(f"{folder} holds {there[0].name} already; give overwrite=true to replace it, or output=FOLDER")
    foreign = [path for path in there if path.is_symlink() or not _OURS.fullmatch(path.name)]
    if foreign:
        raise UserError(f"{folder} holds {foreign[0].name}, which is no frame of an export; give output=FOLDER")
    return place


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `folder` that takes its place when the block succeeds and vanishes when it fails.

    Args:
        folder: where to, see `check_folder`; what is there is moved aside first and deleted last.

    Raises:
        UserError: the place cannot be taken; what was there is still there, and the message says where the new files are.
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
    except OSError as error:
        if aside.exists() and not folder.exists():
            aside.rename(folder)
        raise UserError(f"{folder} could not be replaced ({error.strerror}); the new files are in {temporary}") from None
    shutil.rmtree(aside, ignore_errors=True)


def write_sequence(
    folder: Path, surface: SkinnedSurface, clips: Sequence[Clip], suffix: str, *, weight_colors: bool = False
) -> list[tuple[str, int, str]]:
    """Write `frame_000000.ply` and so on into a folder, several clips into a folder each.

    Args:
        folder: where to; it is there.
        surface: the skinned surface.
        clips: motions, at least one.
        suffix: ply or obj.
        weight_colors: whether vertices are coloured by their weights.

    Returns:
        Clip, frame and reason of those that have no surface, whose number is left out.
    """
    skipped = []
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
    return skipped
