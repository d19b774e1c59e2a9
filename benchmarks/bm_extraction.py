"""Time and memory to extract the posed surface of one frame, field and skinned, at several resolutions; the time of each part.

    python benchmarks/bm_extraction.py          needs `make demo`, or give --avatar

For an avatar with the papers' networks:

    snarf train subject=50002 run=paper_sized training=quick training.steps=1200 skinning=distilled shape=mlp \\
        condition=global shape.prior_radius_m=0.07 shape.geometric_init=false shape.condition_at_start=false
"""

from __future__ import annotations

import os
import threading
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import torch
from common import arguments, in_pytorch, median_and_spread, print_machine, print_table, require, timed

from snarfcli.avatar import Avatar
from snarfcli.meshing import extract
from snarfcli.meshing.extract import extract_surface
from snarfcli.models import system
from snarfcli.motions import builtin_motion


def main() -> None:
    options = arguments(
        "Mesh extraction.",
        avatar={"default": "outputs/builtin/50002/demo/avatar.pt", "help": "a trained avatar"},
        device={"default": "cpu", "help": "where everything is computed, for example cuda"},
        resolutions={"type": int, "nargs": "+", "default": [128, 256], "help": "voxels along the longest side"},
        memory={"action": "store_true", "help": "measure the memory of 512 voxels as well (Linux)"},
    )
    avatar = Avatar.load(require(Path(options.avatar), "make demo"), options.device)
    shape = avatar.config.shape
    motion = builtin_motion("jumping_jacks", 0)
    pose = torch.as_tensor(motion.poses[60], dtype=torch.float32)
    print_machine()
    print(f"network: {shape.depth} layers of {shape.width}, {shape.activation}; condition: {avatar.config.condition.name}\n")
    rows = [_row(avatar, pose, surface, r, options.repeats) for surface in ("field", "skinned") for r in options.resolutions]
    with mock.patch.object(system, "can_evaluate", return_value=False), in_pytorch():
        rows += [_row(avatar, pose, "field", r, options.repeats, ", network in PyTorch") for r in options.resolutions]
    print_table(["surface", "resolution", "first, ms", "then, ms per frame", "vertices", "points evaluated"], rows)
    print()
    parts = [_parts(avatar, pose, r, options.repeats) for r in options.resolutions]
    print_table(["field surface", *parts[0]], [[r, *row.values()] for r, row in zip(options.resolutions, parts, strict=True)])
    if options.memory:
        print()
        rows = [
            ["field, 512", _peak_mib(lambda: avatar.mesh(pose, resolution=512))],
            ["skinned, 512, the first", _peak_mib(lambda: avatar.mesh(pose, resolution=512, surface="skinned"))],
            ["a ball in a cube, 512", _peak_mib(_ball)],
        ]
        print_table(["surface", "peak above the start, MiB"], rows)


def _row(avatar: Avatar, pose: torch.Tensor, surface: str, resolution: int, repeats: int, how: str = "") -> list[str]:
    meshes = []
    avatar.to(avatar.device)  # drops the cached canonical meshes
    start = time.perf_counter()
    avatar.mesh(pose, resolution=resolution, surface=surface)
    first = 1000 * (time.perf_counter() - start)
    seconds = timed(lambda: meshes.append(avatar.mesh(pose, resolution=resolution, surface=surface)), repeats)
    mesh = meshes[-1]
    points = f"{mesh.stats.points:,}" if surface == "field" else ""
    return [surface + how, resolution, f"{first:.0f}", median_and_spread(seconds), f"{len(mesh.vertices):,}", points]


def _parts(avatar: Avatar, pose: torch.Tensor, resolution: int, repeats: int) -> dict[str, str]:
    """Return the mean milliseconds of the parts of a frame; each part waits for the device."""
    seconds: dict[str, float] = defaultdict(float)

    def measured(name: str, function):
        def run(*arguments):
            start, field = _now(avatar), seconds["field"]
            result = function(*arguments)
            seconds[name] += _now(avatar) - start - (seconds["field"] - field)
            return result

        return run

    names = {
        "_evaluate": "lattice",
        "march": "marching cubes",
        "_place": "vertices",
        "keep_components": "components",
        "normals_at_vertices": "normals",
    }
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(avatar, "query", measured("field", avatar.query)))
        for function, name in names.items():
            stack.enter_context(mock.patch.object(extract, function, measured(name, getattr(extract, function))))
        avatar.mesh(pose, resolution=resolution)
        seconds.clear()
        start = _now(avatar)
        for _ in range(repeats):
            avatar.mesh(pose, resolution=resolution)
        whole = _now(avatar) - start
    seconds["other"] = whole - sum(seconds.values())
    return {f"{name}, ms": f"{1000 * seconds[name] / repeats:.1f}" for name in ("field", *names.values(), "other")}


def _now(avatar: Avatar) -> float:
    """Return the time when the device has done all that it was given."""
    if avatar.device.type == "cuda":
        torch.cuda.synchronize(avatar.device)
    return time.perf_counter()


def _ball() -> None:
    extract_surface(lambda points: 0.45 - points.norm(dim=1), torch.full((3,), -0.5), torch.full((3,), 0.5), 512)


def _peak_mib(work) -> str:
    """Return the growth of the resident memory of the process, sampled every 2 ms."""
    page = os.sysconf("SC_PAGE_SIZE")

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * page

    start = resident()
    peak, done = [start], threading.Event()

    def watch() -> None:
        while not done.wait(0.002):
            peak.append(max(peak[-1], resident()))

    watcher = threading.Thread(target=watch)
    watcher.start()
    work()
    done.set()
    watcher.join()
    return f"{(peak[-1] - start) / 2**20:.0f}"


if __name__ == "__main__":
    main()
