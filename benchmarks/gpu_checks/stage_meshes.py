"""Meshes at 256 voxels, of the field and skinned, and the evaluation of samples."""

from __future__ import annotations

import time

import numpy as np
import torch

from gpu_checks.context import AVATARS, PRECISIONS, Context
from snarfcli.avatar import Avatar
from snarfcli.evaluation.evaluate import evaluate
from snarfcli.samples.store import SampleStore

__all__ = ["run"]


def run(context: Context) -> None:
    """Time meshes of both kinds and evaluation, for both avatars."""
    resolution, frames = context.size(256, 24), context.size(30, 2)
    context.section.say(
        f"{frames} poses of the test motion at {resolution} voxels, each mesh complete in the memory of the host: the first",
        "call, which prepares what all poses share, then the others.",
    )
    rows, best = [], (0.0, "")
    for name in AVATARS:
        avatar = context.avatar(name)
        for surface, precision in (*(("field", precision) for precision in PRECISIONS), ("skinned", "highest")):
            precise = avatar.with_precision(precision)
            first, seconds, vertices = _mesh_times(context, precise, surface, resolution, frames)
            per_second = 1 / float(np.median(seconds))
            spread = f"{1000 * min(seconds):.1f}-{1000 * max(seconds):.1f}"
            shown = PRECISIONS[precision]
            times = [f"{first:.2f}", f"{1000 * np.median(seconds):.1f} ({spread})", f"{per_second:.1f}"]
            rows.append([name, surface, shown, *times, vertices])
            context.section.number(f"meshes/{name}/{surface}/{shown}/per second", per_second)
            if surface == "field" and per_second > best[0]:
                best = (per_second, f"avatar with the networks of {name}, in {shown}")
    context.section.table(["avatar", "surface", "network", "first, s", "then, ms", "per second", "vertices"], rows)
    context.section.goal("meshes", *best)
    _evaluation(context)


def _mesh_times(context: Context, avatar: Avatar, surface: str, resolution: int, frames: int) -> tuple[float, list[float], str]:
    """Return the seconds of the first mesh and of each other one, and the number of vertices of the last."""
    store = SampleStore.open(context.pack / "data", "builtin", context.subject)
    poses = torch.from_numpy(store.sequences("test")[0].poses)
    chosen = poses[torch.linspace(0, len(poses) - 1, frames + 1).long()]
    first = context.clock.once(lambda: avatar.mesh(chosen[0], resolution=resolution, surface=surface))
    meshes, seconds = [], []
    for pose in chosen[1:]:
        seconds.append(
            context.clock.once(lambda pose=pose: meshes.append(avatar.mesh(pose, resolution=resolution, surface=surface)))
        )
    return first, seconds, f"{len(meshes[-1].vertices):,}"


def _evaluation(context: Context) -> None:
    """Time the evaluation of samples out of distribution."""
    store, rows = SampleStore.open(context.pack / "data", "builtin", context.subject), []
    for name in AVATARS:
        avatar = context.avatar(name)
        start = time.perf_counter()
        frames = evaluate(avatar, store.sequences("ood"), max_frames=context.size(28, 2), points=context.size(10_000, 200))
        seconds = (time.perf_counter() - start) / len(frames)
        surface = 100 * float(np.mean([frame.iou_surface for frame in frames]))
        rows.append([name, str(len(frames)), f"{frames[0].points:,}", f"{1000 * seconds:.1f}", f"{surface:.1f}"])
        context.section.number(f"evaluation/{name}/ms per frame", 1000 * seconds)
    context.section.say("Evaluation out of distribution, all included:")
    context.section.table(["avatar", "frames", "points per frame", "ms per frame", "IoU surface, %"], rows)
