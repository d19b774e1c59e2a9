"""Where a canonical shape is occupied: samples of the searched cells, and which cells they touch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.deformer import CanonicalGrid, ForwardDeformer
from snarfcli.deformer.cells import corners_of

__all__ = ["SAMPLES_M", "OccupiedSamples", "parts_of_cells", "sample_cells"]

SAMPLES_M = 0.04
"""Largest distance between the samples of a cell, metres; a wrist is 5 cm thick."""
_MOST_SAMPLES = 2**26


@dataclass(frozen=True)
class OccupiedSamples:
    """Which samples are occupied, on a lattice that has the grid's nodes and samples between them."""

    samples: Tensor
    """Zeros and ones, [1, 1, ...]."""
    parts: list[int]
    """Number of parts into which samples divide the sides of a cell, along z, y and x."""
    cell_size: Tensor
    """[3], metres, along x, y and z."""

    def touched_cells(self, reach_m: float) -> Tensor:
        """Return which cells have an occupied sample at most `reach_m` away, along each axis, [D-1, H-1, W-1], bool."""
        near = self.samples
        per_metre = near.new_tensor(self.parts[::-1]) / self.cell_size
        for axis, count in enumerate((reach_m * per_metre - 1e-3).ceil().long().clamp_min(0).tolist()[::-1]):
            along = [count if axis == other else 0 for other in range(3)]
            near = F.max_pool3d(near, [2 * n + 1 for n in along], 1, along)
        return F.max_pool3d(near, self._window, self.parts)[0, 0] > 0

    def surface_cells(self) -> Tensor:
        """Return which cells have occupied and unoccupied samples, [D-1, H-1, W-1], bool."""
        most, least = (sign * F.max_pool3d(sign * self.samples, self._window, self.parts) for sign in (1, -1))
        return (most > least)[0, 0]

    @property
    def _window(self) -> list[int]:
        return [part + 1 for part in self.parts]


@torch.no_grad()
def sample_cells(deformer: ForwardDeformer, shapes: Iterable[Callable[[Tensor], Tensor]], threshold: float) -> OccupiedSamples:
    """Sample the active cells of a deformer.

    Args:
        deformer: has the cells.
        shapes: each gives the logits [M] of canonical points [M, 3]; a sample is occupied where one of them is.
        threshold: logit above which a sample counts as occupied.
    """
    parts = parts_of_cells(deformer.grid, deformer.shape)
    fine = deformer.active_cells
    for axis, factor in enumerate(parts):
        fine = fine.repeat_interleave(factor, axis)
    left = corners_of(fine).reshape(-1).nonzero()[:, 0]  # samples that were not occupied in any shape so far
    nodes = [n + 1 for n in fine.shape]
    places = deformer.grid.nodes(nodes).reshape(-1, 3)
    touched = torch.zeros(nodes, dtype=torch.bool, device=places.device)
    for logits_of in shapes:
        values = logits_of(places[left])
        touched.view(-1)[left[values > threshold]] = True
        left = left[values <= threshold]
    return OccupiedSamples(touched[None, None].float(), parts, deformer.grid.cell_size(deformer.shape))


def parts_of_cells(grid: CanonicalGrid, shape: tuple[int, int, int]) -> list[int]:
    """Return into how many parts samples divide the sides of a cell, along z, y and x, for nodes `shape` = (D, H, W).

    Raises:
        ValueError: there are too many samples.
    """
    parts = [math.ceil(side / SAMPLES_M) for side in grid.cell_size(shape).tolist()[::-1]]
    samples = math.prod(part * (nodes - 1) for part, nodes in zip(parts, shape, strict=True))
    if samples > _MOST_SAMPLES:
        raise ValueError(
            f"grid: wanted a canonical box of at most {_MOST_SAMPLES:,} cells of 4 cm, got one that is "
            f"{grid.longest_side:.3g} m long; units are metres"
        )
    return parts
