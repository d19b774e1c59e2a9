"""Memory of a search, and its share of a training step. Used by bm_search.py."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from common import median_and_spread, resident_bytes
from scenes import QUERY_KINDS, Scene, body_scene
from searches import Method, as_found, methods
from torch import Tensor

__all__ = ["memory_rows", "training_rows"]

MEMORY_HEADER = ["search", "queries", "cells", "number", "roots", "peak, MiB", "of which results, MiB"]
TRAINING_HEADER = ["grid", "search", "forward, ms", "backward, ms", "both, ms", "share of the step"]

_POSES = ("running_on_spot", "knees", "punching", "hips", "chicken_wings", "jumping_jacks", "shake_arms", "shake_hips")


def memory_rows(chosen: list[Method], counts: tuple[int, ...]) -> list[list[str]]:
    """Return the growth of the peak memory (VmHWM) of a process by searches of `counts` queries.

    Each search runs in its own process, in which the C library returns large blocks as soon as they are freed, so that reused
    memory does not hide a part of the growth.
    """
    rows, environment = [], os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
    for method in (m for m in chosen if m.uses_cells or "9 start bones, native" in m.name):
        for kind in QUERY_KINDS:
            for cells in ("near", "all") if method.uses_cells else ("all",):
                for count in counts:
                    request = json.dumps([method.name, kind, cells, count])
                    done = subprocess.run(
                        [sys.executable, __file__, request], capture_output=True, text=True, check=False, env=environment
                    )
                    row = [method.name, kind, cells, f"{count:,}"]
                    if done.returncode:
                        rows.append([*row, "-", f"failed with {done.returncode}: {done.stderr.strip()[-60:]}", "-"])
                        continue
                    got = json.loads(done.stdout.splitlines()[-1])
                    result = got["roots"] * (8 + 4 * 12)  # query, canonical, J^-1
                    rows.append([*row, f"{got['roots']:,}", f"{got['bytes'] / 2**20:,.0f}", f"{result / 2**20:,.0f}"])
    return rows


def _probe(request: str) -> None:
    """Run one search and print the growth of the peak memory of this process."""
    name, kind, cells, count = json.loads(request)
    torch.set_num_threads(min(2, torch.get_num_threads()))
    scene = body_scene("arms_behind_back")
    method = next(m for m in methods() if m.name == name)
    active = scene.near_cells if cells == "near" else None
    points, transforms = scene.queries(kind, count)[None].contiguous(), scene.transforms[None]
    method.run(points[:, :1000], transforms, scene, active)
    before = resident_bytes()
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far (man 5 proc)
    result = method.run(points, transforms, scene, active)
    print(json.dumps({"bytes": _peak_bytes() - before, "roots": len(as_found(result).query)}))


def _peak_bytes() -> int:
    """Return the largest memory of this process since the peak was forgotten."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])


def training_rows(chosen: list[Method], resolution: tuple[int, int, int], repeats: int) -> list[list[str]]:
    """Return the times of the searches' forward and backward pass in a training step of 8 poses x 2,250 points."""
    some = [body_scene(pose, resolution=resolution) for pose in _POSES]
    points = torch.stack([torch.cat([s.queries("cube", 250), s.queries("half near", 4000)[:2000]]) for s in some])
    step = _Step(resolution, some[0], points, torch.stack([s.transforms for s in some]))
    works = {m.name: (lambda m=m: step.search(m)) for m in chosen if m.has_gradient}
    works[f"whole step with {chosen[0].name}"] = lambda: step.whole(chosen[0])
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    for round_number in range(repeats + 1):
        for name, work in works.items():
            measured = work()
            if round_number:
                seconds[name].append(measured)
    whole = statistics.median(sum(pair) for pair in list(seconds.values())[-1])
    rows = []
    for name, pairs in seconds.items():
        forward, backward, both = [a for a, _ in pairs], [b for _, b in pairs], [a + b for a, b in pairs]
        share = f"{100 * statistics.median(both) / whole:.1f} %"
        rows.append(["x".join(map(str, resolution)), name, *map(median_and_spread, (forward, backward, both)), share])
    return rows


class _Step:
    """A training step with the networks of the papers; the skinning weights stay those of the body, as after training."""

    def __init__(self, resolution: tuple[int, int, int], scene: Scene, points: Tensor, transforms: Tensor) -> None:
        from hydra import compose, initialize_config_dir
        from omegaconf import OmegaConf

        from snarfcli.commands.train import TrainConfig
        from snarfcli.datasets.builtin import builtin_subject
        from snarfcli.hydra_config.schema import config_folder, register_schemas
        from snarfcli.models.fast_snarf import FastSnarf
        from snarfcli.models.settings import AvatarConfig

        register_schemas("train", TrainConfig)
        overrides = ["training=paper", "subject=50002", f"skinning.resolution={list(resolution)}"]
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = OmegaConf.to_object(compose("train", overrides))
        surface = torch.as_tensor(scene.surface[::25], dtype=torch.float32)
        networks = AvatarConfig(config.model, config.skinning, config.search, config.shape)
        self.model = FastSnarf(networks, builtin_subject("50002").skeleton, scene.grid, surface).train()
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=1e-4)
        self.scene, self.points, self.transforms = scene, points, transforms
        self.pose = torch.zeros(len(points), 24, 3)
        self.labels = (torch.rand(points.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.5).float()

    def _find(self, method: Method, weights: Tensor):
        scene = replace(self.scene, weights=weights)
        return method.run(self.points, self.transforms, scene, self.model.deformer.active_cells if method.uses_cells else None)

    def search(self, method: Method) -> tuple[float, float]:
        """Return the seconds of the search alone with the blending of the transforms: forward, and backward to the weights."""
        weights = self.scene.weights.clone().requires_grad_()
        start = time.perf_counter()
        found = self._find(method, weights)
        middle = time.perf_counter()
        found.canonical.backward(torch.ones_like(found.canonical))
        return middle - start, time.perf_counter() - middle

    def whole(self, method: Method) -> tuple[float, float]:
        """Return the seconds of a whole step: forward, and backward with the optimiser."""
        start = time.perf_counter()
        learned = self.model.deformer.field(self.scene.grid.nodes(self.scene.shape).reshape(-1, 3))
        found = self._find(method, self.scene.weights + 0 * learned.reshape(self.scene.weights.shape))
        logits = self.model.canonical_logits(found.canonical, self.model.condition(self.pose), found.pose)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(found.maximum(logits, -30.0), self.labels)
        middle = time.perf_counter()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return middle - start, time.perf_counter() - middle


if __name__ == "__main__":
    _probe(sys.argv[1])
