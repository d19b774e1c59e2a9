"""Peak memory of searches, queries and meshes, beyond what was there before."""

from __future__ import annotations

import gc
from collections.abc import Callable

import torch

from gpu_checks.context import AVATARS, Context
from gpu_checks.scene_cases import NEAR

__all__ = ["run"]


def run(context: Context) -> None:
    """Measure the peaks, on a GPU those of PyTorch's allocator."""
    rows = []
    for count in (200_000, 1_000_000, 10_000_000):
        case = context.scenes.case("knees", NEAR, context.size(count, count // 10_000))
        assert case.transforms is not None  # blended before, like the queries
        rows.append([f"search of {case.points.shape[1]:,} queries", _peak(context, case.complete)])
        rows.append([f"released search of {case.points.shape[1]:,} queries", _peak(context, case.released)])
        del case
    for name in AVATARS:
        avatar, case = context.avatar(name), context.scenes.case("knees", NEAR, context.size(200_000, 100))
        angles = context.scenes.saved["poses"]["knees"]["pose"]
        bones = avatar.bone_transforms(angles[None])
        pose = angles[None].to(context.device)
        queries = f"{case.points.shape[1]:,} queries"
        rows.append([f"{name}, {queries}", _peak(context, lambda a=avatar, c=case, b=bones, p=pose: a.query(c.points, b, p))])
        resolution = context.size(256, 16)
        mesh = f"{name}, field mesh at {resolution}"
        rows.append([mesh, _peak(context, lambda a=avatar, p=angles, r=resolution: a.mesh(p, resolution=r))])
    context.section.say(
        "MiB beyond the inputs, results included." if context.device.type == "cuda" else "Not measured on a CPU."
    )
    context.section.table(["work", "peak, MiB"], rows)


def _peak(context: Context, work: Callable[[], object]) -> str:
    """Return the growth of the allocated memory in one call, MiB; on a CPU the work runs and "-" is returned."""
    gc.collect()
    if context.device.type != "cuda":
        work()
        return "-"
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    result = work()
    torch.cuda.synchronize()
    peak = torch.cuda.max_memory_allocated() - before
    del result
    return f"{peak / 2**20:.0f}"
