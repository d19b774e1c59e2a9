"""`snarf export format=bvh`: write motions without a mesh, on the avatar's skeleton or on that of the motion file."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import cast

from snarfcli.bodies import Skeleton
from snarfcli.commands.export_places import (
    check_place,
    clip_files,
    default_place,
    read_clips,
    subject_name,
    wanted_motions,
    write_record,
    writing,
)
from snarfcli.commands.export_settings import ExportConfig
from snarfcli.commands.selection import load_selected_avatar, select_frames
from snarfcli.errors import UserError
from snarfcli.export.bvh import UNITS, BvhOptions, export_bvh
from snarfcli.export.clips import Clip
from snarfcli.export.joint_naming import named_joints
from snarfcli.export.rig_clips import rig_clip, up_axis_of
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.reader import RIG_SUFFIXES, average_skeleton, read_rig
from snarfcli.motions.retarget import choose_clip
from snarfcli.motions.up_axis import Up
from snarfcli.names import folder_name
from snarfcli.runs import machine_facts

__all__ = ["write_motions"]

log = logging.getLogger(__name__)

_UPS = ("auto", "y", "z")
_Part = tuple[Skeleton, Clip, BvhOptions]
"""The content of one file."""


def write_motions(config: ExportConfig) -> int:
    """Write one BVH file per motion, and a record beside them; return 0.

    Raises:
        UserError: the avatar or a motion does not exist, or a setting cannot be used.
    """
    if config.output is not None:
        check_place(config, Path(config.output))
    if config.skeleton == "file":
        parts = [_part_of_file(config, pose, motion) for pose, motion in wanted_motions(config)]
        place = default_place(config, Path(config.output_root), folder_name(parts[0][1].motion.name))
    else:
        parts, place = _parts_of_avatar(config)
    output = check_place(config, Path(config.output) if config.output else place)
    files = clip_files(config, output, [clip.motion.name for _, clip, _ in parts], "bvh")
    parts = [
        (replace(skeleton, names=named_joints(skeleton.names, skeleton.parents, config.names)), clip, options)
        for skeleton, clip, options in parts
    ]
    with writing(config, output, files):
        reports = [
            export_bvh(file, clip, skeleton, options, overwrite=True)
            for file, (skeleton, clip, options) in zip(files, parts, strict=True)
        ]
        facts = [{**asdict(report), "path": report.path.name} for report in reports]
        write_record(config, output, {"files": facts, **machine_facts()})
    for report in reports:
        for line in report.lines():
            log.info("%s", line)
    return 0


def _parts_of_avatar(config: ExportConfig) -> tuple[list[_Part], Path]:
    """Return the motions on the avatar's skeleton, and the default output."""
    try:
        avatar, path = load_selected_avatar(config)
    except UserError as error:
        raise UserError(f"{error}; or give skeleton=file for the skeleton of the motion file") from None
    units = UNITS["cm" if config.bvh.units == "auto" else config.bvh.units]
    options = BvhOptions(units, up="z" if config.bvh.up == "z" else "y", order=config.bvh.order)
    parts = [(avatar.skeleton, clip, options) for clip in read_clips(config, avatar)]
    return parts, default_place(config, path.parent, subject_name(config, avatar))


def _part_of_file(config: ExportConfig, pose: str | None, motion: str | None) -> _Part:
    """Return a motion on its own skeleton, or on that of an average adult if it has none."""
    if config.height == "ground":
        raise UserError(
            "height: wanted file or auto with skeleton=file, which has no surface, got ground; give skeleton=avatar"
        )
    if pose is not None and Path(pose).suffix.lower() in RIG_SUFFIXES and not Path(pose).is_dir():
        return _part_of_rig(config, Path(pose))
    skeleton = average_skeleton()
    if pose is None:
        whole = builtin_motion(motion or "jumping_jacks", config.motion_seed, frame_rate=config.motion_frame_rate)
    else:
        settings = {"hands": config.hands, "rest": config.rest, "mapping": config.mapping, "clip": config.clip}
        whole = read_motion(pose, skeleton, up=cast(Up, config.up), **settings)
        log.info("%s: the skeleton of an average adult is written; give skeleton=avatar for another", pose)
    units = UNITS["cm" if config.bvh.units == "auto" else config.bvh.units]
    options = BvhOptions(units, up="z" if config.bvh.up == "z" else "y", order=config.bvh.order)
    return skeleton, Clip(select_frames(config, whole).motion), options


def _part_of_rig(config: ExportConfig, path: Path) -> _Part:
    """Return a clip of a file on the file's skeleton, in its units and axes unless others are wanted."""
    for name, is_given in (("mapping", config.mapping is not None), ("rest", config.rest != "auto")):
        if is_given:
            log.warning("%s: not used with skeleton=file, whose joints stay as they are", name)
    if config.up not in _UPS:
        raise UserError(f"up: wanted {', '.join(_UPS)} with skeleton=file, got {config.up}; give skeleton=avatar")
    rig = read_rig(path)
    skeleton, clip = rig_clip(rig, choose_clip(rig, config.clip, path), path)
    is_bvh = path.suffix.lower() == ".bvh"
    if is_bvh and config.bvh.units != "auto":
        raise UserError(
            f"bvh.units: wanted auto for the skeleton of {path.name}, since BVH files do not say their unit, got "
            f"{config.bvh.units}; leave it out, or give skeleton=avatar"
        )
    up = config.up
    if up == "auto":
        up = "y"
        if is_bvh and (config.in_place or config.bvh.up != "auto"):
            up = up_axis_of(skeleton, clip)
            log.info("%s: %s is taken as up in this file; give up=y or up=z for the other", path.name, up)
    chosen = select_frames(config, clip.motion, clip.bone_transforms, up=up)
    name = path.stem if len(rig.clips) == 1 else f"{path.stem}_{clip.motion.name}"
    options = BvhOptions(
        units_per_metre=1.0 if config.bvh.units == "auto" else UNITS[config.bvh.units],
        up=up if config.bvh.up == "auto" else config.bvh.up,
        skeleton_up=up,
        order=config.bvh.order,
        end_sites=not is_bvh,
        root_offset=is_bvh,
    )
    return skeleton, Clip(replace(chosen.motion, name=name), chosen.bone_transforms), options
