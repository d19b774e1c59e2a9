"""`snarf animate`: write posed meshes and a video of an avatar in motion."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.avatar import Avatar
from snarfcli.checks import check_choice, check_number
from snarfcli.commands.animate_settings import AnimateConfig
from snarfcli.commands.animation_folder import POSTER, RECORD, VIDEO, folder_name, frame_settings, prepare_folder
from snarfcli.commands.ground_truth import ground_truth_meshes
from snarfcli.commands.selection import (
    SelectedMotion,
    check_motion_selection,
    load_selected_avatar,
    select_motion,
)
from snarfcli.errors import UserError
from snarfcli.files import remove_temporaries, write_json
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.mesh_files import MESH_WRITERS
from snarfcli.meshing.posed import RESOLUTIONS, SURFACES
from snarfcli.meshing.surfaces import canonical_surface
from snarfcli.motions import Motion
from snarfcli.output_locks import hold_output
from snarfcli.parallel import count_cores, parse_processes
from snarfcli.rendering.animation import CONTENTS, Animation, GroundTruthMeshes, place_canonical
from snarfcli.rendering.panels import Screen, picture_size
from snarfcli.rendering.pictures import frame_processes, make_pictures
from snarfcli.rendering.sheet import write_png
from snarfcli.rendering.stage import CAMERAS, body_points, set_stage
from snarfcli.rendering.video import write_video
from snarfcli.rendering.views import View, parse_turntable, parse_views
from snarfcli.runs import machine_facts
from snarfcli.texts import counted

__all__ = ["AnimateConfig", "run"]

log = logging.getLogger(__name__)

_LARGEST_PICTURE = 4096
_TRUE_FRAMES, _TRUE_POINTS = 16, 300  # sampled from the ground truth, so that the camera shows all of it


def run(config: AnimateConfig) -> int:
    """Write one mesh per frame, a video and `animation.json`; an interrupted run continues where it stopped.

    Returns:
        0, or 1 if some frames have no surface.

    Raises:
        UserError: the avatar or the motion does not exist, or a setting cannot be used.
    """
    plan = _check(config)
    avatar, path = load_selected_avatar(config)
    _check_system(config, avatar)
    chosen = select_motion(config, config, avatar.skeleton, config.pose, config.motion)
    motion, count = chosen.motion, len(chosen.numbers)
    truth = (
        ground_truth_meshes(config, config, avatar, chosen, config.pose) if config.video and "truth" in config.beside else None
    )
    on_cpu = avatar.device.type == "cpu"
    processes = frame_processes(plan.processes, count, config.resolution, extract=on_cpu, draw=config.video)
    folder = Path(config.output) if config.output else path.parent / "animation" / folder_name(motion.name)
    log.info("avatar: %s, on %s", path, avatar.device)
    log.info("motion: %s, %s at %g per second", motion.name, counted(motion.num_frames, "frame"), motion.frame_rate)
    with hold_output(folder, "snarf animate", wait=config.wait):
        settings = frame_settings(config, path, chosen)
        prepare_folder(folder, settings, config.overwrite)
        try:
            animation, record = _animate(config, plan, avatar, path, chosen, truth, folder, processes)
        finally:
            remove_temporaries(folder)  # of worker processes that were ended
        write_json(folder / RECORD, {"complete": True, "settings": settings, **record})
    return _report(config, animation, record["timings"])


def _animate(
    config: AnimateConfig,
    plan: _Plan,
    avatar: Avatar,
    path: Path,
    chosen: SelectedMotion,
    truth: GroundTruthMeshes | None,
    folder: Path,
    processes: int,
) -> tuple[Animation, dict[str, Any]]:
    """Write meshes and video of the avatar of the file `path`; return the animation and its record."""
    motion, count, on_cpu = chosen.motion, len(chosen.numbers), avatar.device.type == "cpu"
    start = time.perf_counter()
    canonical = _canonical(config, avatar)
    animation = Animation(
        avatar,
        motion.name,
        motion.poses,
        motion.translation,
        chosen.numbers,
        surface=config.surface,
        resolution=config.resolution,
        folder=folder,
        suffix=config.format if config.meshes else None,
        weights_from=canonical,
        weight_colors=config.weight_colors,
        keep_share=config.keep_share,
        bone_transforms=chosen.bone_transforms,
        screen=_screen(config, plan, avatar, chosen, canonical, truth) if config.video else None,
        truth=truth,
    )
    threads = max(1, (config.threads or count_cores()) // processes)
    if processes > 1:
        log.info("%d processes %s", processes, f"of {counted(threads, 'thread')}" if on_cpu else "draw")
    pictures = make_pictures(animation, processes, threads, extracts_here=not on_cpu)
    try:
        if config.video:
            write_video(folder / VIDEO, _with_poster(pictures, count // 2, folder / POSTER), motion.frame_rate)
        else:
            for _ in pictures:
                pass
    except KeyboardInterrupt:
        done = len(animation.frames)
        log.info("stopped after %d of %s; run the same command to continue", done, counted(count, "frame"))
        raise
    record = _record(config, animation, motion, path, processes, time.perf_counter() - start)
    return animation, record | machine_facts(avatar.device)


@dataclass(frozen=True)
class _Plan:
    """Parsed settings of pictures and processes."""

    size: tuple[int, int]
    views: tuple[View, ...]
    turn_rad_s: float
    processes: int | None


def _check(config: AnimateConfig) -> _Plan:
    """Check all settings before any work starts."""
    for name, choices in (("surface", SURFACES), ("format", tuple(MESH_WRITERS)), ("camera", CAMERAS)):
        check_choice(name, getattr(config, name), choices)
    check_motion_selection(config)
    check_number("resolution", config.resolution, *RESOLUTIONS)
    check_number("keep_share", config.keep_share, 0, 1)
    check_number("azimuth_deg", config.azimuth_deg, -360, 360)
    check_number("elevation_deg", config.elevation_deg, -89, 89)
    if not (config.meshes or config.video):
        raise UserError("meshes, video: wanted at least one, got false for both; set one to true")
    size = re.fullmatch(r"\s*(\d+)(?:\s*x\s*(\d+))?\s*", config.video_size)
    numbers = (int(size[1]), int(size[2] or size[1])) if size else (0, 0)
    if not all(16 <= pixels <= _LARGEST_PICTURE for pixels in numbers):
        raise UserError(f"video_size: wanted pixels such as 512 or 1280x720, 16 to {_LARGEST_PICTURE}, got {config.video_size}")
    views = parse_views(config.views, config.azimuth_deg, config.elevation_deg)
    for name in config.beside:
        check_choice("beside", name, CONTENTS)
        if name == config.surface:
            raise UserError(f"beside=[{name}]: surface={name} shows this already; give the other surface")
        if config.beside.count(name) > 1:
            raise UserError(f"beside: wanted each panel once, got '{name}' twice; leave one out")
    picture_size(numbers, 1 + len(config.beside), len(views))
    return _Plan(numbers, views, parse_turntable(config.turntable), parse_processes(config.processes))


def _screen(
    config: AnimateConfig,
    plan: _Plan,
    avatar: Avatar,
    chosen: SelectedMotion,
    canonical: Mesh | None,
    truth: GroundTruthMeshes | None,
) -> Screen:
    """Return the panels of the video: cameras and floor for the whole motion."""
    motion = chosen.motion
    points = body_points(avatar, motion.poses, motion.translation, canonical, chosen.bone_transforms)
    also = beside = None
    if truth is not None:
        also = points[:, :_TRUE_POINTS].copy()
        for frame in np.unique(np.linspace(0, len(points) - 1, _TRUE_FRAMES).astype(int)):
            vertices = truth[frame][0]
            also[frame] = vertices[np.linspace(0, len(vertices) - 1, also.shape[1]).astype(int)]
    if "canonical" in config.beside and canonical is not None:
        beside = place_canonical(canonical.vertices, canonical, 0.0, 0.0)
    stage = set_stage(
        points,
        motion.poses,
        plan.views,
        frame_rate=motion.frame_rate,
        aspect=plan.size[0] / plan.size[1],
        camera=config.camera,
        turn_rad_s=plan.turn_rad_s,
        also=also,
        beside=beside,
    )
    other = {"skinned", "field"} & set(config.beside)
    contents = {"avatar": f"{config.surface} surface" if other else "avatar"}
    contents |= {name: CONTENTS[name] for name in config.beside}
    return Screen(stage, plan.size, contents, settled=["canonical"])


def _with_poster(pictures: Iterator[np.ndarray | None], index: int, path: Path) -> Iterator[np.ndarray]:
    """Yield the pictures, and write the one with number `index` as PNG."""
    for number, picture in enumerate(pictures):
        assert picture is not None  # pictures are drawn whenever there is a video
        if number == index:
            write_png(path, picture)
        yield picture


def _check_system(config: AnimateConfig, avatar: Avatar) -> None:
    """Reject settings that need skinning weights for an avatar without them."""
    if avatar.has_skinning_weights:
        return
    needing = [f"beside=[{name}]" for name in config.beside if name in ("canonical", "skinned", "weights")]
    if config.weight_colors:
        needing.insert(0, "weight_colors=true")
    if config.surface == "skinned":
        needing.insert(0, "surface=skinned")
    wanted = needing[0] if needing else None
    if wanted:
        raise UserError(
            f"{wanted} needs skinning weights of canonical points, which model {avatar.config.model.name} does not have; "
            "leave it out, or use an avatar of model=fast_snarf"
        )


def _canonical(config: AnimateConfig, avatar: Avatar) -> Mesh | None:
    """Return a canonical mesh for colours and cameras; None if it is not needed or the surface is empty."""
    if not (config.video or config.weight_colors) or not avatar.has_skinning_weights:
        return None
    try:
        if config.weight_colors or config.surface == "skinned" or {"skinned", "canonical", "weights"} & set(config.beside):
            # The avatar caches it, and is pickled with it for worker processes.
            return avatar.skinned_surface(config.resolution, config.keep_share).mesh
        return canonical_surface(avatar, avatar.skeleton.canonical_pose.float(), min(64, config.resolution))
    except (EmptySurface, FullSurface):
        return None


def _record(
    config: AnimateConfig, animation: Animation, motion: Motion, avatar: Path, processes: int, seconds: float
) -> dict[str, Any]:
    """Return the content of `animation.json`, without the machine."""
    frames = animation.frames
    return {
        "config": asdict(config),
        "avatar": str(avatar),
        "motion": {"name": motion.name, "frames": motion.num_frames, "frame_rate": motion.frame_rate},
        "video": VIDEO if config.video else None,
        "poster": POSTER if config.video else None,
        "frames": [asdict(frame) for frame in frames],
        "skipped": [{"frame": frame.frame, "reason": frame.problem} for frame in frames if frame.problem],
        "missing": [{"frame": frame.frame, "reason": text} for frame in frames for text in frame.missing],
        "timings": {
            "total_s": round(seconds, 3),
            "extraction_s": round(sum(frame.extraction_s for frame in frames), 3),
            "rendering_s": round(sum(frame.rendering_s for frame in frames), 3),
            "processes": processes,
            "frames_a_second": round(len(frames) / max(seconds, 1e-9), 3),
        },
    }


def _report(config: AnimateConfig, animation: Animation, timings: dict[str, float]) -> int:
    """Print what was written and where, and return the exit code."""
    frames, folder = animation.frames, animation.folder
    skipped = sum(frame.problem is not None for frame in frames)
    kept = sum(frame.was_there for frame in frames)
    log.info(
        "%s in %.1f s, %.2f frames per second%s",
        counted(len(frames), "frame"), timings["total_s"], timings["frames_a_second"],
        f"; {kept} existed already" if kept else "",
    )  # fmt: skip
    if config.meshes and skipped < len(frames):
        log.info("meshes: %s", folder / f"frame_*.{config.format}")
    if config.video:
        log.info("video: %s, its middle frame: %s", folder / VIDEO, POSTER)
    pieces = sum((frame.components or 0) > 1 for frame in frames)
    if pieces:
        log.info("%s with loose pieces; keep_share=0.1 removes all but large ones", counted(pieces, "frame"))
    if skipped:
        log.warning("%d of %s without a surface; see %s", skipped, counted(len(frames), "frame"), folder / RECORD)
    incomplete = sum(bool(frame.missing) for frame in frames)
    if incomplete:
        of_frames = counted(len(frames), "frame")
        log.warning("%d of %s without a panel beside the avatar; see %s", incomplete, of_frames, folder / RECORD)
    return 1 if skipped or incomplete else 0
