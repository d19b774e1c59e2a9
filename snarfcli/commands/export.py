"""`snarf export`: write an avatar as a rigged, animated character for other programs, its motions, or itself."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from snarfcli.avatar import Avatar
from snarfcli.commands.export_bvh import write_motions
from snarfcli.commands.export_places import (
    check_place,
    clip_files,
    default_place,
    read_clips,
    subject_name,
    write_record,
    writing,
)
from snarfcli.commands.export_pretrained import write_folder
from snarfcli.commands.export_settings import ExportConfig, check_settings
from snarfcli.commands.selection import load_selected_avatar
from snarfcli.errors import UserError
from snarfcli.export.blender import BLENDER_FORMATS, convert, find_blender
from snarfcli.export.character import CharacterOptions
from snarfcli.export.character_surface import character_surface, check_avatar
from snarfcli.export.clips import Clip
from snarfcli.export.export import ExportReport, export_character
from snarfcli.export.html import export_html
from snarfcli.export.human_bones import human_bones
from snarfcli.export.joint_naming import named_joints
from snarfcli.export.sequence import atomic_folder, write_sequence
from snarfcli.export.vrm import export_vrm
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.runs import machine_facts, run_folder
from snarfcli.texts import counted

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
    if config.format == "pretrained":
        return write_folder(config)
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
        motion = clip.motion
        log.info("motion: %s, %s at %g per second", motion.name, counted(motion.num_frames, "frame"), motion.frame_rate)
    files = clip_files(config, output, [clip.motion.name for clip in clips], "vrma") if config.format == "vrm" else []
    writers = {"vrm": _write_vrm, "html": _write_html, **dict.fromkeys(MESH_WRITERS, _write_meshes)}
    write = writers.get(config.format, _write_character)
    job = _Job(config, avatar, path, clips, options, output, files, blender, time.perf_counter())
    with writing(config, output, files):
        lines, skipped = write(job)
    for line in lines:
        log.info("%s", line)
    for name, frame, reason in skipped:
        log.warning("clip %s, frame %d: the shape could not be computed: %s", name, frame, reason)
    return 1 if skipped else 0


@dataclass(frozen=True)
class _Job:
    """One export, with everything read and checked."""

    config: ExportConfig
    avatar: Avatar
    path: Path
    """File of the avatar."""
    clips: list[Clip]
    options: CharacterOptions
    output: Path
    files: list[Path]
    """Files of the clips, where the format has them."""
    blender: list[str]
    """Command, for formats that Blender writes."""
    start: float
    """Time at the start, seconds."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in the files."""
        return named_joints(self.avatar.skeleton.names, self.avatar.skeleton.parents, self.config.names)

    @property
    def subject(self) -> str:
        """Name of the subject in the files."""
        return subject_name(self.config, self.avatar)

    def record(self, place: Path, facts: dict[str, Any]) -> None:
        """Write the record of the export, which completes it."""
        seconds = round(time.perf_counter() - self.start, 2)
        machine = machine_facts(self.avatar.device)
        write_record(self.config, place, {"avatar": str(self.path), **facts, "seconds": seconds, **machine})


_Written = tuple[list[str], tuple[tuple[str, int, str], ...]]
"""Lines to print, and frames whose shape could not be computed."""


def _write_character(job: _Job) -> _Written:
    """Write the file; fbx and usd are converted by Blender from a temporary .glb."""

    def export(path: Path) -> ExportReport:
        return export_character(
            job.avatar, path, job.clips, job.options, name=job.subject, joint_names=job.joint_names, overwrite=True
        )

    if not job.blender:
        report = export(job.output)
        size = report.num_bytes
    else:
        rates = [clip.motion.frame_rate for clip in job.clips]
        if len(set(rates)) > 1:
            text = "the motions have different frame rates; %s can have one, and gets %g"
            log.warning(text, job.config.format, rates[0])
        with TemporaryDirectory() as folder:
            glb = Path(folder) / f"{job.subject}.glb"
            report = export(glb)
            log.info("converting to %s in Blender", job.config.format)
            size = convert(job.blender, glb, job.output, rates[0])
    job.record(job.output, {"file": job.output.name, "bytes": size, **report.facts()})
    return [*report.lines(), f"{job.output}: {size / 1e6:.2f} MB"], report.skipped


def _write_vrm(job: _Job) -> _Written:
    """Write the model, and each clip as .vrma beside it."""
    report = export_vrm(
        job.avatar,
        job.output,
        job.clips,
        job.options,
        job.config.vrm,
        name=job.subject,
        joint_names=job.joint_names,
        clip_files=job.files,
        overwrite=True,
    )
    names = [file.name for file in job.files]
    job.record(job.output, {"file": job.output.name, "bytes": report.num_bytes, "clip_files": names, **report.facts()})
    return [*report.lines(), f"{job.output}: {report.num_bytes / 1e6:.2f} MB; clips in {', '.join(names)}"], report.skipped


def _write_html(job: _Job) -> _Written:
    """Write the page."""
    report, notes = export_html(
        job.avatar,
        job.output,
        job.clips,
        job.options,
        job.config.html,
        name=job.subject,
        joint_names=job.joint_names,
        overwrite=True,
    )
    job.record(job.output, {"file": job.output.name, "bytes": report.num_bytes, "reduced": notes, **report.facts()})
    return [*report.lines(), *notes, f"{job.output}: {report.num_bytes / 1e6:.2f} MB; open it in a browser"], report.skipped


def _write_meshes(job: _Job) -> _Written:
    """Write one mesh per frame."""
    surface = character_surface(job.avatar, job.options)
    frames = sum(clip.motion.num_frames for clip in job.clips)
    vertices, triangles = len(surface.mesh.vertices), len(surface.mesh.faces)
    with atomic_folder(job.output) as folder:
        skipped = write_sequence(folder, surface, job.clips, job.config.format, weight_colors=job.config.weight_colors)
        job.record(folder, {"frames": frames, "vertices": vertices, "triangles": triangles, "skipped": skipped})
    lines = [f"{counted(frames - len(skipped), 'frame')} of {vertices} vertices and {triangles} triangles each in {job.output}"]
    return lines, tuple(skipped)
