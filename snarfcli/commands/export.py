"""`snarf export`: write an avatar as a rigged, animated character for other programs, or its motions."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from snarfcli.avatar import Avatar
from snarfcli.commands.export_bvh import write_motions
from snarfcli.commands.export_places import check_place, clip_files, default_place, read_clips, record_file, subject_name
from snarfcli.commands.export_settings import ExportConfig, check_settings
from snarfcli.commands.selection import load_selected_avatar
from snarfcli.errors import UserError
from snarfcli.export.blender import BLENDER_FORMATS, convert, find_blender
from snarfcli.export.character import CharacterOptions
from snarfcli.export.character_surface import character_surface, check_avatar
from snarfcli.export.clips import Clip
from snarfcli.export.export import ExportReport, export_character
from snarfcli.export.human_bones import human_bones
from snarfcli.export.joint_naming import named_joints
from snarfcli.export.sequence import atomic_folder, write_sequence
from snarfcli.export.vrm import export_vrm
from snarfcli.files import write_json
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.runs import machine_facts, run_folder

__all__ = ["ExportConfig", "run"]

log = logging.getLogger(__name__)


def run(config: ExportConfig) -> int:
    """Write the character, and a record of the export beside it.

    Returns:
        0, or 1 if the shape could not be computed in some frames.

    Raises:
        UserError: the avatar or a motion does not exist, or a setting cannot be used.
    """
    options = check_settings(config)
    if config.format == "bvh":
        return write_motions(config)
    blender = find_blender() if config.format in BLENDER_FORMATS else []
    if config.output is not None:  # before the avatar is loaded
        check_place(config, Path(config.output))
    elif config.ckpt is None:
        trained_on = config.data.avatars or config.data.name
        folder = run_folder(config.output_root, trained_on, config.subject, config.run)
        check_place(config, default_place(config, folder, config.subject))
    avatar, path = load_selected_avatar(config)
    check_avatar(avatar)
    if config.format == "vrm":  # before the surface is made
        human_bones(avatar.skeleton)
    named_joints(avatar.skeleton.names, avatar.skeleton.parents, config.names)
    output = Path(config.output) if config.output else default_place(config, path.parent, subject_name(config, avatar))
    output = check_place(config, output)
    clips = read_clips(config, avatar)
    if config.format == "usd" and len(clips) > 1:
        raise UserError(f"usd: wanted one motion, got {len(clips)}; export them one by one, or give format=glb")
    log.info("avatar: %s, on %s", path, avatar.device)
    for clip in clips:
        log.info("motion: %s, %d frames at %g per second", clip.motion.name, clip.motion.num_frames, clip.motion.frame_rate)
    start = time.perf_counter()
    write = _write_meshes if config.format in MESH_WRITERS else _write_vrm if config.format == "vrm" else _write_character
    facts, lines, skipped = write(config, avatar, clips, options, output, blender)
    seconds = round(time.perf_counter() - start, 2)
    record = {"config": asdict(config), "avatar": str(path), **facts, "seconds": seconds, **machine_facts()}
    write_json(record_file(config, output), record)
    for line in lines:
        log.info("%s", line)
    for name, frame, reason in skipped:
        log.warning("clip %s, frame %d: the shape could not be computed: %s", name, frame, reason)
    return 1 if skipped else 0


_Written = tuple[dict[str, Any], list[str], tuple[tuple[str, int, str], ...]]
"""Facts for the record, lines to print, and frames whose shape could not be computed."""


def _write_character(
    config: ExportConfig, avatar: Avatar, clips: list[Clip], options: CharacterOptions, output: Path, blender: list[str]
) -> _Written:
    """Write the file; fbx and usd are converted by Blender from a temporary .glb."""
    subject = subject_name(config, avatar)
    names = named_joints(avatar.skeleton.names, avatar.skeleton.parents, config.names)

    def export(path: Path) -> ExportReport:
        return export_character(avatar, path, clips, options, name=subject, joint_names=names, overwrite=config.overwrite)

    if not blender:
        report = export(output)
        size = report.num_bytes
    else:
        rates = {clip.motion.frame_rate for clip in clips}
        if len(rates) > 1:
            log.warning(
                "the motions have different frame rates; %s can have one, and gets %g",
                config.format,
                clips[0].motion.frame_rate,
            )
        with TemporaryDirectory() as folder:
            glb = Path(folder) / f"{subject}.glb"
            report = export(glb)
            log.info("converting to %s in Blender", config.format)
            size = convert(blender, glb, output, clips[0].motion.frame_rate)
    lines = [*report.lines(), f"{output}: {size / 1e6:.2f} MB"]
    return {"file": output.name, "bytes": size, **report.facts()}, lines, report.skipped


def _write_vrm(
    config: ExportConfig, avatar: Avatar, clips: list[Clip], options: CharacterOptions, output: Path, blender: list[str]
) -> _Written:
    """Write the model, and each clip as .vrma beside it."""
    files = clip_files(config, output, [clip.motion.name for clip in clips], "vrma")
    report = export_vrm(
        avatar,
        output,
        clips,
        options,
        config.vrm,
        name=subject_name(config, avatar),
        joint_names=named_joints(avatar.skeleton.names, avatar.skeleton.parents, config.names),
        clip_files=files,
        overwrite=config.overwrite,
    )
    lines = [*report.lines(), f"{output}: {report.num_bytes / 1e6:.2f} MB; clips in {', '.join(file.name for file in files)}"]
    facts = {"file": output.name, "bytes": report.num_bytes, "clip_files": [file.name for file in files], **report.facts()}
    return facts, lines, report.skipped


def _write_meshes(
    config: ExportConfig, avatar: Avatar, clips: list[Clip], options: CharacterOptions, output: Path, blender: list[str]
) -> _Written:
    """Write one mesh per frame."""
    surface = character_surface(avatar, options)
    with atomic_folder(output) as folder:
        skipped = write_sequence(folder, surface, clips, config.format, weight_colors=config.weight_colors)
    frames = sum(clip.motion.num_frames for clip in clips)
    vertices, triangles = len(surface.mesh.vertices), len(surface.mesh.faces)
    lines = [f"{frames - len(skipped)} frames of {vertices} vertices and {triangles} triangles each in {output}"]
    return {"frames": frames, "vertices": vertices, "triangles": triangles, "skipped": skipped}, lines, tuple(skipped)
