"""`snarf export`: write an avatar as a rigged, animated character for other programs."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from omegaconf import MISSING

from snarfcli.avatar import Avatar
from snarfcli.checks import check_choice
from snarfcli.commands.selection import (
    BUILTIN_MOTIONS,
    AvatarSelection,
    MotionSelection,
    check_motion_selection,
    load_selected_avatar,
    select_motion,
)
from snarfcli.errors import UserError
from snarfcli.export.blender import BLENDER_FORMATS, convert, find_blender
from snarfcli.export.character import CharacterOptions, check_options
from snarfcli.export.character_surface import character_surface, check_avatar
from snarfcli.export.clips import HEIGHTS, Clip, on_ground
from snarfcli.export.export import ExportReport, check_output, export_character
from snarfcli.export.sequence import atomic_folder, check_folder, write_sequence
from snarfcli.files import write_json
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.names import folder_name
from snarfcli.runs import machine_facts, run_folder

__all__ = ["ExportConfig", "run"]

log = logging.getLogger(__name__)

_GROUND_RESOLUTION = 128
_FORMATS = ("glb", *MESH_WRITERS, *BLENDER_FORMATS)
_RECORD = "export.json"


@dataclass
class ExportConfig(MotionSelection, AvatarSelection):
    """Settings of `snarf export`."""

    pose: list[str] | None = MISSING
    """Motion files (.npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .vrma) or folders of frames; each becomes one clip."""
    motion: list[str] | None = MISSING
    """Built-in motions (SMPL) or sequences of the samples (other skeletons); each becomes one clip. Without motions and pose
    files: jumping_jacks or the held-out sequence."""
    format: str = MISSING
    """glb (mesh, rig, clips and shapes in one file), fbx or usd (the same, needs Blender), ply or obj (one mesh per frame)."""
    triangles: int | None = MISSING
    """Maximum number of triangles; null does not simplify the mesh."""
    influences: int = MISSING
    """Maximum number of joints per vertex: 4, or 8, which fewer programs read."""
    morph_targets: int = MISSING
    """Maximum number of morph targets for the pose-dependent shape; 0 uses the mean shape over the clips."""
    resolution: int = MISSING
    """Voxels along the longest side of the canonical box in which the mesh is extracted."""
    weight_colors: bool = MISSING
    """Colour vertices by their skinning weights."""
    height: str = MISSING
    """Height of the clips: ground (lowest point of each at y = 0), file (as in the motion), or auto: ground for built-in
    motions, file for pose files."""
    output: str | None = MISSING
    """Output file, or folder for ply and obj; null for export/<subject>.<format> beside the avatar."""
    overwrite: bool = MISSING
    """Replace existing output."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""


def run(config: ExportConfig) -> int:
    """Write the character, and a record of the export beside it.

    Returns:
        0, or 1 if the shape could not be computed in some frames.

    Raises:
        UserError: the avatar or a motion does not exist, or a setting cannot be used.
    """
    options = _check(config)
    blender = find_blender() if config.format in BLENDER_FORMATS else []
    if config.output is not None:  # before the avatar is loaded
        _check_place(config, Path(config.output))
    elif config.ckpt is None:
        trained_on = config.data.avatars or config.data.name
        folder = run_folder(config.output_root, trained_on, config.subject, config.run)
        _check_place(config, _place(config, folder, config.subject))
    avatar, path = load_selected_avatar(config)
    check_avatar(avatar)
    output = Path(config.output) if config.output else _place(config, path.parent, _subject(config, avatar))
    output = _check_place(config, output)
    clips = _clips(config, avatar)
    if config.format == "usd" and len(clips) > 1:
        raise UserError(f"usd: wanted one motion, got {len(clips)}; export them one by one, or give format=glb")
    log.info("avatar: %s, on %s", path, avatar.device)
    for clip in clips:
        log.info("motion: %s, %d frames at %g per second", clip.motion.name, clip.motion.num_frames, clip.motion.frame_rate)
    start = time.perf_counter()
    write = _write_meshes if config.format in MESH_WRITERS else _write_character
    facts, lines, skipped = write(config, avatar, clips, options, output, blender)
    seconds = round(time.perf_counter() - start, 2)
    record = {"config": asdict(config), "avatar": str(path), **facts, "seconds": seconds, **machine_facts()}
    write_json(_record(config, output), record)
    for line in lines:
        log.info("%s", line)
    for name, frame, reason in skipped:
        log.warning("clip %s, frame %d: the shape could not be computed: %s", name, frame, reason)
    return 1 if skipped else 0


def _check(config: ExportConfig) -> CharacterOptions:
    """Check all settings before any work starts; return the options of the character."""
    check_choice("format", config.format, _FORMATS)
    check_choice("height", config.height, HEIGHTS)
    options = CharacterOptions(
        triangles=config.triangles,
        influences=config.influences,
        morph_targets=config.morph_targets,
        resolution=config.resolution,
        weight_colors=config.weight_colors,
    )
    check_options(options)
    check_motion_selection(config)
    if config.format in MESH_WRITERS:
        unused = {name: getattr(config, name) for name in ("influences", "morph_targets")}
        given = [f"{name}={value}" for name, value in unused.items() if value != getattr(CharacterOptions, name)]
        if given:  # a message, not an error: presets set them for all formats
            text = "%s: not used with format=%s, whose meshes have all weights and the exact shape"
            log.warning(text, ", ".join(given), config.format)
    return options


def _subject(config: ExportConfig, avatar: Avatar) -> str:
    """Return the subject as a valid file name. (With ckpt=FILE only the avatar knows the subject.)"""
    return folder_name(str(avatar.facts.get("subject") or config.subject), "avatar")


def _place(config: ExportConfig, folder: Path, subject: str) -> Path:
    """Return the default output: a file, or a folder for meshes."""
    joint = "_" if config.format in MESH_WRITERS else "."
    return folder / "export" / f"{subject}{joint}{config.format}"


def _check_place(config: ExportConfig, output: Path) -> Path:
    """Check that the output does not exist (or may be replaced) and has the suffix of the format; return its path."""
    if config.format in MESH_WRITERS:
        return check_folder(output, config.overwrite)
    suffix = output.suffix.lower().lstrip(".")
    if suffix != config.format:
        hint = f"give format={suffix}, or " if suffix in (*BLENDER_FORMATS, "glb") else ""
        raise UserError(f"output: wanted a name ending in .{config.format}, got {output}; {hint}give another name")
    check_output(output, config.overwrite)
    check_output(_record(config, output), config.overwrite)
    return output


def _record(config: ExportConfig, output: Path) -> Path:
    """Return the file of the record: in the folder of meshes, or beside the output file."""
    return output / _RECORD if config.format in MESH_WRITERS else output.with_name(f"{output.stem}_{output.suffix[1:]}.json")


def _clips(config: ExportConfig, avatar: Avatar) -> list[Clip]:
    """Read all motions, and move those to the ground for which `height` says so."""
    wanted: list[tuple[str | None, str | None]] = [(pose, None) for pose in config.pose or ()]
    wanted += [(None, motion) for motion in config.motion or ()]
    clips = []
    for pose, motion in wanted or [(None, None)]:
        chosen = select_motion(config, config, avatar.skeleton, pose, motion)
        clip = Clip(chosen.motion, chosen.bone_transforms)
        is_builtin = pose is None and clip.bone_transforms is None and clip.motion.name in BUILTIN_MOTIONS
        if config.height == "ground" or (config.height == "auto" and is_builtin):
            rough = CharacterOptions(triangles=None, resolution=min(_GROUND_RESOLUTION, config.resolution))
            clip, up = on_ground(character_surface(avatar, rough).mesh, avatar.skeleton, clip)
            log.info("%s stands on y = 0: moved by %.3f m", clip.motion.name, up)
        clips.append(clip)
    return clips


_Written = tuple[dict[str, Any], list[str], tuple[tuple[str, int, str], ...]]
"""Facts for the record, lines to print, and frames whose shape could not be computed."""


def _write_character(
    config: ExportConfig, avatar: Avatar, clips: list[Clip], options: CharacterOptions, output: Path, blender: list[str]
) -> _Written:
    """Write the file; fbx and usd are converted by Blender from a temporary .glb."""
    subject = _subject(config, avatar)

    def export(path: Path) -> ExportReport:
        return export_character(avatar, path, clips, options, name=subject, overwrite=config.overwrite)

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
