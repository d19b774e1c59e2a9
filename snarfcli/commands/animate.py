"""`snarf animate`: meshes and a video of an avatar in motion."""

from __future__ import annotations

import hashlib
import logging
import math
import re
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import MISSING

from snarfcli.bodies import Skeleton
from snarfcli.checks import check_choice, check_number
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.stored_motion import stored_motion
from snarfcli.errors import UserError
from snarfcli.export.animation import Animation
from snarfcli.export.meshes import MESH_WRITERS
from snarfcli.export.stage import set_stage
from snarfcli.export.video import write_video
from snarfcli.files import read_json, write_json
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import SURFACES, canonical_surface
from snarfcli.models.avatar import Avatar
from snarfcli.motions import OUT_OF_DISTRIBUTION_SEQUENCES, TRAINING_SEQUENCES, Motion, builtin_motion, read_motion
from snarfcli.motions.layouts import HANDS, SMPL, layout_of
from snarfcli.motions.world import UPS
from snarfcli.runs import choose_device, find_avatar, machine_facts, run_folder, set_threads

__all__ = ["AnimateConfig", "run"]

log = logging.getLogger(__name__)

_MOTION = "jumping_jacks"
_BUILTIN_MOTIONS = (*TRAINING_SEQUENCES, *OUT_OF_DISTRIBUTION_SEQUENCES)
_RECORD = "animation.json"
_VIDEO = "video.mp4"
_RESOLUTIONS = (16, 1024)  # dense lattices: 1024 take some 4 GB for a body with its arms spread
_FRAME_RATES = (1.0, 1000.0)
_LARGEST_PICTURE = 4096


@dataclass
class AnimateConfig:
    """Settings of `snarf animate`."""

    subject: str = MISSING
    """Whose avatar, such as 50002."""
    data: DataConfig = MISSING
    """Which data the avatar was trained on."""
    data_root: str = MISSING
    """Folder with the processed samples, whose motions are for skeletons that the built-in ones do not fit."""
    output_root: str = MISSING
    """Folder with the runs; the avatar is <output_root>/<data>/<subject>/<run>/avatar.pt."""
    run: str = MISSING
    """Name of the run."""
    ckpt: str | None = MISSING
    """Avatar file or run folder to use instead; results go beside it."""
    pose: str | None = MISSING
    """Motion: .npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .gltf, or a folder of frames; null for the built-in `motion`."""
    up: str = MISSING
    """Which way is up in the pose file: auto, y or z."""
    hands: str = MISSING
    """SMPL's hand joints where the pose file has fingers: rest (straight) or released (as the released code took them)."""
    mapping: str | None = MISSING
    """For .bvh and .glb: JSON file {joint of the avatar: joint of the pose file}; null goes by the usual names."""
    clip: str | None = MISSING
    """For .bvh and .glb: name or number of the animation; null for the first."""
    motion: str | None = MISSING
    """Without a pose file: a built-in motion of SMPL's joints, or a sequence of the samples of any other skeleton; null for
    jumping_jacks, or for the held-out sequence."""
    motion_seed: int = MISSING
    """Variant of the built-in motion."""
    motion_frame_rate: float = MISSING
    """Frames a second of the built-in motion."""
    start: int = MISSING
    """First frame."""
    stop: int | None = MISSING
    """Frame to stop before; null for the end."""
    step: int = MISSING
    """Take every so many frames; the video keeps the pace."""
    max_frames: int | None = MISSING
    """Stop after so many frames; null for all."""
    surface: str = MISSING
    """field (the union, watertight) or skinned (the canonical mesh moved by its skin)."""
    resolution: int = MISSING
    """Voxels along the longest side: 128, 256, 512 or any number from 16 to 1024."""
    keep_share: float = MISSING
    """Loose pieces with fewer faces than this share of the largest surface's are dropped."""
    meshes: bool = MISSING
    """Whether to write a mesh a frame."""
    format: str = MISSING
    """Format of the meshes: ply or obj."""
    weight_colors: bool = MISSING
    """Whether vertices are coloured by their skinning weights."""
    video: bool = MISSING
    """Whether to draw a video."""
    video_size: str = MISSING
    """Pixels of the video: 512, or width x height such as 1280x720."""
    azimuth_deg: float = MISSING
    """Where the camera stands: degrees from straight ahead of the body towards its left."""
    elevation_deg: float = MISSING
    """Degrees that the camera looks down."""
    output: str | None = MISSING
    """Folder for the results; null for animation/<motion> beside the avatar."""
    overwrite: bool = MISSING
    """Start again, even over frames made with other settings."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    threads: int | None = MISSING
    """Threads for tensor work; null leaves PyTorch's choice."""
    experiment: str | None = None
    """Name of the preset of settings that the rest starts from; null for none."""


def run(config: AnimateConfig) -> int:
    """Write a mesh a frame, a video and `animation.json`; an interrupted run goes on where it stopped.

    Returns:
        0, or 1 if some frames have no surface.

    Raises:
        UserError: there is no avatar or no motion, or a setting cannot be used.
    """
    size = _check(config)
    trained_on = config.data.avatars or config.data.name
    subject_folder = run_folder(config.output_root, trained_on, config.subject, config.run).parent
    unknown = config.data.name == "builtin" and config.subject not in BUILTIN_SUBJECTS
    if unknown and config.ckpt is None and not subject_folder.exists():
        builtin_subject(config.subject)  # says which name is near
    path = find_avatar(config.output_root, trained_on, config.subject, config.run, config.ckpt)
    device = choose_device(config.device)
    set_threads(config.threads)
    avatar = Avatar.load(path, device)
    _check_system(config, avatar)
    whole, transforms = _read(config, avatar.skeleton)
    motion, numbers = _selected(config, whole)
    transforms = None if transforms is None else transforms[numbers]
    folder = Path(config.output) if config.output else path.parent / "animation" / _file_name(motion.name)
    settings = _settings(config, path, whole, numbers)
    _prepare(folder, settings, config.overwrite)
    log.info("avatar: %s, on %s", path, device)
    log.info("motion: %s, %d frames at %g a second", motion.name, motion.num_frames, motion.frame_rate)

    start = time.perf_counter()
    canonical = _canonical(config, avatar, motion)
    animation = Animation(
        avatar,
        motion.name,
        motion.poses,
        motion.translation,
        numbers,
        surface=config.surface,
        resolution=config.resolution,
        folder=folder,
        suffix=config.format if config.meshes else None,
        weights_from=canonical,
        weight_colors=config.weight_colors,
        keep_share=config.keep_share,
        bone_transforms=transforms,
    )
    try:
        if config.video:
            stage = set_stage(
                avatar,
                motion.poses,
                motion.translation,
                canonical,
                aspect=size[0] / size[1],
                azimuth_rad=math.radians(config.azimuth_deg),
                elevation_rad=math.radians(config.elevation_deg),
                bone_transforms=transforms,
            )
            write_video(folder / _VIDEO, animation.pictures(stage, size), motion.frame_rate)
        else:
            for _ in animation.meshes():
                pass
    except KeyboardInterrupt:
        done = len(animation.frames)
        log.info("stopped after %d of %d frames; the same command goes on from there", done, len(numbers))
        raise
    record = _record(config, animation, motion, path, time.perf_counter() - start)
    write_json(folder / _RECORD, {"complete": True, "settings": settings, **record})
    return _report(config, animation, record["timings"])


def _check(config: AnimateConfig) -> tuple[int, int]:
    """Refuse settings that cannot be used, before any work starts; return the size of the video."""
    for name, choices in (("surface", SURFACES), ("format", tuple(MESH_WRITERS)), ("up", UPS), ("hands", HANDS)):
        check_choice(name, getattr(config, name), choices)
    for name, least in (("step", 1), ("max_frames", 1), ("motion_seed", 0)):
        check_number(name, getattr(config, name), least)
    check_number("resolution", config.resolution, *_RESOLUTIONS)
    check_number("keep_share", config.keep_share, 0, 1)
    check_number("motion_frame_rate", config.motion_frame_rate, *_FRAME_RATES)
    check_number("azimuth_deg", config.azimuth_deg, -360, 360)
    check_number("elevation_deg", config.elevation_deg, -89, 89)
    if not (config.meshes or config.video):
        raise UserError("nothing to make: both meshes and video are false")
    size = re.fullmatch(r"\s*(\d+)(?:\s*x\s*(\d+))?\s*", config.video_size)
    numbers = (int(size[1]), int(size[2] or size[1])) if size else (0, 0)
    if not all(16 <= pixels <= _LARGEST_PICTURE for pixels in numbers):
        raise UserError(
            f"video_size must be a number such as 512 or 1280x720, 16 to {_LARGEST_PICTURE}, got {config.video_size}"
        )
    return numbers


def _check_system(config: AnimateConfig, avatar: Avatar) -> None:
    """Refuse what needs skinning weights of an avatar without any."""
    if avatar.has_skinning_weights:
        return
    wanted = "surface=skinned" if config.surface == "skinned" else "weight_colors=true" if config.weight_colors else None
    if wanted:
        raise UserError(
            f"{wanted} needs skinning weights of canonical points, which model {avatar.config.model.name} does not have; "
            "leave it out, or take an avatar of model=fast_snarf"
        )


def _read(config: AnimateConfig, skeleton: Skeleton) -> tuple[Motion, NDArray[np.float32] | None]:
    """Return the whole motion, with y up, and its bone transforms where the poses do not say it all."""
    if config.pose is not None:
        motion = read_motion(
            config.pose, skeleton, up=config.up, hands=config.hands, mapping=config.mapping, clip=config.clip
        )
        return motion, None
    is_smpl = layout_of(skeleton) == SMPL
    if not is_smpl and config.data.name != "builtin" and config.motion not in _BUILTIN_MOTIONS:
        return stored_motion(config.data_root, config.data.name, config.subject, config.motion, skeleton)
    motion = builtin_motion(config.motion or _MOTION, config.motion_seed, frame_rate=config.motion_frame_rate)
    if not is_smpl:
        raise UserError(
            f"motion {motion.name} is for SMPL's 24 joints, the avatar has {skeleton.num_joints} of another kind;"
            " give a motion of its own by --pose FILE, such as .bvh, .glb or .npz"
        )
    return motion, None


def _selected(config: AnimateConfig, motion: Motion) -> tuple[Motion, list[int]]:
    """Return the frames asked for and their numbers in the motion."""
    numbers = list(range(*slice(config.start, config.stop, config.step).indices(motion.num_frames)))[: config.max_frames]
    if not numbers:
        raise UserError(
            f"start={config.start}, stop={config.stop} leave no frame: {motion.name} has frames 0 to {motion.num_frames - 1}"
        )
    poses, translation = motion.poses[numbers], motion.translation[numbers]
    return replace(motion, poses=poses, translation=translation, frame_rate=motion.frame_rate / config.step), numbers


def _file_name(name: str) -> str:
    """Return a motion's name as a folder's."""
    return re.sub(r"[^\w.+-]+", "_", name).strip(".") or "motion"


def _settings(config: AnimateConfig, avatar: Path, whole: Motion, numbers: list[int]) -> dict[str, Any]:
    """Return what the frames depend on: frames of other settings must not be mixed with them."""
    digest = hashlib.sha256(whole.poses.tobytes() + whole.translation.tobytes())
    return {
        "avatar_sha256": hashlib.sha256(avatar.read_bytes()).hexdigest(),
        "motion_sha256": digest.hexdigest(),
        "start": numbers[0],
        "step": config.step,
        "surface": config.surface,
        "resolution": config.resolution,
        "keep_share": config.keep_share,
        "format": config.format,
        "weight_colors": config.weight_colors,
    }


def _prepare(folder: Path, settings: dict[str, Any], overwrite: bool) -> None:
    """Make the folder ready: keep frames of the same settings, refuse others, or start again."""
    record = folder / _RECORD
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
        there = [*folder.glob("frame_*.ply"), *folder.glob("frame_*.obj"), *folder.glob(_VIDEO)]
        if there and not overwrite:  # without a record they are somebody else's
            raise UserError(
                f"{folder} holds {there[0].name} of unknown origin; give overwrite=true to replace it, or output=FOLDER"
            )
        for stale in there:
            stale.unlink(missing_ok=True)
    write_json(record, {"complete": False, "settings": settings})


def _canonical(config: AnimateConfig, avatar: Avatar, motion: Motion) -> Mesh | None:
    """Return the canonical body in the first pose, for colours and camera; None without need or if there is none."""
    if not (config.video or config.weight_colors) or not avatar.has_skinning_weights:
        return None
    resolution = min(128, config.resolution) if config.weight_colors else min(64, config.resolution)
    try:
        return canonical_surface(avatar, torch.from_numpy(motion.poses[0]).float(), resolution)
    except (EmptySurface, FullSurface):
        return None


def _record(config: AnimateConfig, animation: Animation, motion: Motion, avatar: Path, seconds: float) -> dict[str, Any]:
    """Return the facts for `animation.json`."""
    frames = animation.frames
    return {
        "config": asdict(config),
        "avatar": str(avatar),
        "motion": {"name": motion.name, "frames": motion.num_frames, "frame_rate": motion.frame_rate},
        "video": _VIDEO if config.video else None,
        "frames": [asdict(frame) for frame in frames],
        "skipped": [{"frame": frame.frame, "reason": frame.problem} for frame in frames if frame.problem],
        "timings": {
            "total_s": round(seconds, 3),
            "extraction_s": round(sum(frame.extraction_s for frame in frames), 3),
            "rendering_s": round(sum(frame.rendering_s for frame in frames), 3),
            "frames_a_second": round(len(frames) / max(seconds, 1e-9), 3),
        },
        **machine_facts(),
    }


def _report(config: AnimateConfig, animation: Animation, timings: dict[str, float]) -> int:
    """Say what was made and where it is, and return the exit code."""
    frames, folder = animation.frames, animation.folder
    skipped = sum(frame.problem is not None for frame in frames)
    kept = sum(frame.points == 0 and frame.problem is None for frame in frames)
    log.info(
        "%d frames in %.1f s, %.2f frames a second%s",
        len(frames), timings["total_s"], timings["frames_a_second"], f"; {kept} were there already" if kept else "",
    )  # fmt: skip
    if config.meshes and skipped < len(frames):
        log.info("meshes: %s", folder / f"frame_*.{config.format}")
    if config.video:
        log.info("video: %s", folder / _VIDEO)
    pieces = sum(frame.components > 1 for frame in frames)
    if pieces:
        log.info("%d frames have loose pieces; keep_share=0.1 would drop all but large ones", pieces)
    if skipped:
        log.warning("%d of %d frames have no surface; see %s", skipped, len(frames), folder / _RECORD)
    return 1 if skipped else 0
