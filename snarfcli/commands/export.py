"""`snarf export`: an avatar as a rigged, animated character for other programs."""

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
    """Motion files, each a clip: .npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .gltf, or a folder of frames."""
    motion: list[str] | None = MISSING
    """Built-in motions of SMPL's joints, or sequences of the samples of any other skeleton, each a clip; with neither these nor
    pose files there is one clip, jumping_jacks or the held-out sequence."""
    format: str = MISSING
    """glb (mesh, rig, clips and shapes in one file), fbx or usd (the same, through Blender), ply or obj (a mesh a frame)."""
    triangles: int | None = MISSING
    """Most triangles of the mesh; null leaves it as it was extracted."""
    influences: int = MISSING
    """Joints that move one vertex: 4, or 8, which fewer programs read."""
    morph_targets: int = MISSING
    """Most shapes that are blended for the pose-dependent shape; 0 for one shape, the mean over the clips."""
    resolution: int = MISSING
    """Voxels along the longest side of the canonical box, from which the mesh is made."""
    weight_colors: bool = MISSING
    """Whether vertices are coloured by their skinning weights."""
    height: str = MISSING
    """How high the clips are: ground (the lowest point of each at y = 0), file (as their motions have it), or auto: built-in
    motions on the ground, pose files as they are."""
    output: str | None = MISSING
    """File, or folder for ply and obj; null for export/<subject>.<format> beside the avatar."""
    overwrite: bool = MISSING
    """Whether what is there already is replaced."""
    experiment: str | None = None
    """Name of the preset of settings that the rest starts from; null for none."""


def run(config: ExportConfig) -> int:
    """Write the character and a record of it beside it.

    Returns:
        0, or 1 if the shape could not be followed in some frames.

    Raises:
        UserError: there is no avatar or no motion, or a setting cannot be used.
    """
    options = _check(config)
    blender = find_blender() if config.format in BLENDER_FORMATS else []
    if config.output is not None:  # before anything is loaded; the other place is known once the avatar is
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
        raise UserError(f"usd holds one timeline, got {len(clips)} motions; export them one by one, or give format=glb")
    log.info("avatar: %s, on %s", path, avatar.device)
    for clip in clips:
        log.info("motion: %s, %d frames at %g a second", clip.motion.name, clip.motion.num_frames, clip.motion.frame_rate)
    start = time.perf_counter()
    write = _write_meshes if config.format in MESH_WRITERS else _write_character
    facts, lines, skipped = write(config, avatar, clips, options, output, blender)
    seconds = round(time.perf_counter() - start, 2)
    record = {"config": asdict(config), "avatar": str(path), **facts, "seconds": seconds, **machine_facts()}
    write_json(_record(config, output), record)
    for line in lines:
        log.info("%s", line)
    for name, frame, reason in skipped:
        log.warning("clip %s, frame %d: the shape could not be followed: %s", name, frame, reason)
    return 1 if skipped else 0


def _check(config: ExportConfig) -> CharacterOptions:
    """Refuse settings that cannot be used, before any work starts; return what the character may cost."""
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
        if given:  # a line, no refusal: presets set them whatever the format
            text = "%s: not used, meshes of format=%s have all weights and their own shape"
            log.warning(text, ", ".join(given), config.format)
    return options


def _subject(config: ExportConfig, avatar: Avatar) -> str:
    """Return whose avatar it is, which with ckpt=FILE only the avatar knows, as a file or mesh may be called."""
    return folder_name(str(avatar.facts.get("subject") or config.subject), "avatar")


def _place(config: ExportConfig, folder: Path, subject: str) -> Path:
    """Return where the result goes if nobody says so: a file, or for meshes a folder."""
    joint = "_" if config.format in MESH_WRITERS else "."
    return folder / "export" / f"{subject}{joint}{config.format}"


def _check_place(config: ExportConfig, output: Path) -> Path:
    """Refuse a place that is taken, or a name that says another format; return it as it is written to."""
    if config.format in MESH_WRITERS:
        return check_folder(output, config.overwrite)
    suffix = output.suffix.lower().lstrip(".")
    if suffix != config.format:
        hint = f"give format={suffix}, or " if suffix in (*BLENDER_FORMATS, "glb") else ""
        raise UserError(f"output {output} should end in .{config.format}; {hint}give another name")
    check_output(output, config.overwrite)
    check_output(_record(config, output), config.overwrite)
    return output


def _record(config: ExportConfig, output: Path) -> Path:
    """Return where the record goes: into a folder of meshes, or beside a file."""
    return output / _RECORD if config.format in MESH_WRITERS else output.with_name(f"{output.stem}_{output.suffix[1:]}.json")


def _clips(config: ExportConfig, avatar: Avatar) -> list[Clip]:
    """Read all motions, and put those on the ground that should stand there."""
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
"""Facts for the record, lines for people, and frames whose shape could not be followed."""


def _write_character(
    config: ExportConfig, avatar: Avatar, clips: list[Clip], options: CharacterOptions, output: Path, blender: list[str]
) -> _Written:
    """Write the file; in a format of Blender's from a temporary .glb."""
    subject = _subject(config, avatar)

    def export(path: Path) -> ExportReport:
        return export_character(avatar, path, clips, options, name=subject, overwrite=config.overwrite)

    if not blender:
        report = export(output)
        size = report.num_bytes
    else:
        rates = {clip.motion.frame_rate for clip in clips}
        if len(rates) > 1:
            log.warning("the motions have several frame rates, %s has one: %g", config.format, clips[0].motion.frame_rate)
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
    """Write a mesh a frame."""
    surface = character_surface(avatar, options)
    with atomic_folder(output) as folder:
        skipped = write_sequence(folder, surface, clips, config.format, weight_colors=config.weight_colors)
    frames = sum(clip.motion.num_frames for clip in clips)
    vertices, triangles = len(surface.mesh.vertices), len(surface.mesh.faces)
    lines = [f"{frames - len(skipped)} frames of {vertices} vertices and {triangles} triangles each in {output}"]
    return {"frames": frames, "vertices": vertices, "triangles": triangles, "skipped": skipped}, lines, tuple(skipped)
