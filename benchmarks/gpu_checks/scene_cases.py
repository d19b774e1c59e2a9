"""Queries in packed scenes, and the searches of both sides on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from released_kernels import PaddedRoots, released_search_native
from torch import Tensor

from snarfcli.deformer import CanonicalGrid, SearchConfig, implicit, ops
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.deformer.starts import start_transforms

__all__ = ["NEAR", "POSES", "Case", "Scenes"]

POSES = ("knees", "deep_squats")
"""Poses of the packed scenes: mild, and out of distribution."""
NEAR = "cells near the body"
_BACKEND = "native"
_NOISE_M = 0.01  # standard deviation of the queries near the surface
_SPARE = 1024  # roots for which a search with a capacity has room beyond those found


@dataclass
class Case:
    """Queries in one pose or several."""

    name: str
    weights: Tensor
    """[D, H, W, J], skinning weights."""
    bones: Tensor
    """[B, J, 4, 4], canonical to posed, metres."""
    grid: CanonicalGrid
    points: Tensor
    """[B, N, 3], posed space, metres."""
    active: Tensor | None
    """[D-1, H-1, W-1], the cells to search; None for all. The released search has none."""
    nine: list[int]
    """The released start bones."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes (D, H, W)."""
        depth, height, width = self.weights.shape[:3]
        return depth, height, width

    @cached_property
    def transforms(self) -> Tensor:
        """Blended transforms at the nodes, [B, D * H * W, 12], which both sides compute once per pose."""
        return blend_transforms(self.weights, self.bones)

    @cached_property
    def starts(self) -> Tensor:
        """Inverse transforms of the released start bones, [B, I, 12]."""
        return start_transforms(self.bones, self.nine)

    def complete(self, capacity: int | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Run this package's search: canonical [M, 3], query [M], jacobian_inverse [M, 3, 3], number of roots [1]."""
        box = (self.grid.lower, self.grid.upper, self.shape)
        search = SearchConfig()
        settings = (self.active, search.tolerance, search.max_steps, False, capacity, _BACKEND)
        return ops.complete_search(self.points, self.transforms, *box, *settings)

    def released(self, steps: int = 10) -> PaddedRoots:
        """Run the released search with a maximum number of steps."""
        return released_search_native(self.points, self.transforms, self.starts, self.grid, self.shape, steps)

    def released_roots(self) -> Tensor:
        """Run the released search as callers do: gather its roots, [M, 3], for which the host waits."""
        found = self.released()
        return found.canonical[found.valid]

    def backward(self, found: tuple[Tensor, ...], gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients by queries and by transforms of a loss with the gradient [M, 3] by the roots."""
        sizes = (self.grid.lower, self.grid.upper, self.shape, *self.points.shape[:2], True, True)
        return implicit.implicit_backward(gradient, *found[:3], *sizes, _BACKEND)

    def capacity(self) -> int:
        """Return a capacity that holds all roots."""
        return len(self.complete()[1]) + _SPARE


class Scenes:
    """The packed scenes on a device.

    Args:
        saved: as `pack_gpu_check.py` has written them.
        device: of the cases.
    """

    def __init__(self, saved: dict[str, Any], device: torch.device) -> None:
        self.saved, self.device = saved, device
        weights: Tensor = saved["weights"].to(device).float()  # packed in half precision, in which they no longer sum to 1
        self.weights = weights / weights.sum(-1, keepdim=True)
        self.near: Tensor = saved["near"].to(device)
        self.grid = CanonicalGrid(*saved["box"].to(device))

    @classmethod
    def load(cls, path: Path, device: torch.device) -> Scenes:
        """Read the scenes of a pack."""
        return cls(torch.load(path, weights_only=True), device)

    def case(self, pose: str, cells: str, count: int, batch: int = 1) -> Case:
        """Return queries of one pose, one of `POSES`.

        Args:
            pose: name of the pose.
            cells: `NEAR`, or anything else for all cells.
            count: number of queries per pose, half of them uniform in the papers' cube, half near the surface.
            batch: how often the pose is repeated, with other queries.
        """
        saved = self.saved["poses"][pose]
        bones = saved["bones"].to(self.device).expand(batch, -1, -1, -1).contiguous()
        points = _queries(saved["surface"], saved["cube"], batch * count).reshape(batch, count, 3).to(self.device)
        active = self.near if cells == NEAR else None
        return Case(f"{pose}, {cells}", self.weights, bones, self.grid, points, active, list(self.saved["nine"]))


def _queries(surface: Tensor, cube: Tensor, count: int) -> Tensor:
    """Return queries [count, 3] in posed space, in random order.

    Args:
        surface: [S, 3], points on the posed surface.
        cube: [4], lower corner and side of the papers' cube.
        count: number of queries.
    """
    generator = torch.Generator().manual_seed(0)
    uniform = cube[:3] + cube[3] * torch.rand(count - count // 2, 3, generator=generator)
    chosen = surface[torch.randint(len(surface), (count // 2,), generator=generator)]
    near = chosen + _NOISE_M * torch.randn(count // 2, 3, generator=generator)
    points = torch.cat([uniform, near])
    return points[torch.randperm(count, generator=generator)]
