"""Feature grids: numbers at the nodes of grids of several resolutions over the canonical box, optimised with the network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["FeatureGrids", "grid_nodes"]

_MOST_NODES = 2**25  # of all levels; a row number takes four bytes of each, features only those that are covered
_LEAST_CELL = 1e-9  # of the longest side of the box; smaller cells are counted as these, which are far too many anyway
_START = 1e-4  # features start within this of zero, as in Mueller et al.


def grid_nodes(lower: Tensor, upper: Tensor, cells_m: Sequence[float]) -> list[list[int]]:
    """Return the numbers of nodes W, H, D of feature grids.

    Args:
        lower, upper: corners of the box, [3], metres.
        cells_m: side of a cell of each level, metres.

    Raises:
        ValueError: a level is coarser than the box, or its cells are not positive.
    """
    extent = [float(side) for side in upper - lower]
    levels = []
    for cell in cells_m:
        if not 0 < cell <= max(extent):
            raise ValueError(
                f"shape.feature_cells_m: wanted cells of more than 0 and at most {max(extent):.3g} m, the longest side of "
                f"the canonical box, got {cell:g}"
            )
        levels.append([math.ceil(side / max(cell, _LEAST_CELL * max(extent)) - 1e-6) + 1 for side in extent])
    return levels


class FeatureGrids(nn.Module):
    """Features at the nodes of dense grids, stored only where the grids are covered.

    A level's nodes lie on a regular lattice over the box. Nodes outside the covered region have no features and count as zeros.

    Args:
        lower, upper: corners of the box, [3], metres.
        cells_m: side of a cell of each level, metres.
        features: F, numbers per node.

    Raises:
        ValueError: a level is coarser than the box, its cells are not positive, or the grids have too many nodes.

    Source: after Mueller et al., Instant Neural Graphics Primitives, SIGGRAPH 2022, Sec. 3, without hashing.
    """

    rows: Tensor
    """Row of each node's features, int32; the [D, H, W] nodes of all levels one after the other; -1 where there are none."""

    def __init__(self, lower: Tensor, upper: Tensor, cells_m: Sequence[float], features: int) -> None:
        super().__init__()
        if not 1 <= features <= 16:
            raise ValueError(f"shape.features: wanted 1 to 16, got {features}")
        self.features = features
        self.nodes: list[int] = []
        """W, H, D of each level."""
        self.boxes: list[float] = []
        """Position of the first node and sides of a cell of each level, metres."""
        extent = [float(side) for side in upper - lower]
        for level in grid_nodes(lower, upper, cells_m):
            self.nodes += level
            self.boxes += [float(x) for x in lower] + [side / (n - 1) for side, n in zip(extent, level, strict=True)]
        if self.num_nodes > _MOST_NODES:
            finest = (math.prod(extent) / _MOST_NODES * 1.5) ** (1 / 3)
            raise ValueError(
                f"shape.feature_cells_m: the grids would have {self.num_nodes / 1e6:.0f} million nodes; wanted at most "
                f"{_MOST_NODES / 1e6:.0f} million; give cells of {finest:.2g} m or more"
            )
        self.register_buffer("rows", torch.full((self.num_nodes,), -1, dtype=torch.int32))
        self.table = nn.Parameter(torch.empty(0, features))

    @property
    def arrays(self) -> tuple[Tensor, Tensor, list[int], list[float]]:
        """Table, rows, nodes and boxes, as `networks.encode` takes them."""
        return self.table, self.rows, self.nodes, self.boxes

    @property
    def size(self) -> int:
        """Number of features at a point."""
        return self.num_levels * self.features

    @property
    def num_levels(self) -> int:
        return len(self.nodes) // 3

    @property
    def num_nodes(self) -> int:
        return sum(math.prod(self.nodes[3 * level : 3 * level + 3]) for level in range(self.num_levels))

    @torch.no_grad()
    def cover(self, cells: Tensor | None = None) -> int:
        """Give features to the nodes around some cells of the box; those that have some keep them.

        Args:
            cells: bool [D, H, W], cells of equal size that fill the box; None for the whole box.

        Returns:
            Number of new rows; the parameter `table` is another one then, with the new rows last.
        """
        wanted = []
        for level in range(self.num_levels):
            width, height, depth = self.nodes[3 * level : 3 * level + 3]
            if cells is None:
                wanted.append(torch.ones(depth * height * width, dtype=torch.bool))
                continue
            shape = (depth - 1, height - 1, width - 1)
            overlaps = [_overlaps(have, want) for have, want in zip(cells.shape, shape, strict=True)]
            covered = torch.einsum("zyx,az,by,cx->abc", cells.cpu().float(), *overlaps) > 0
            nodes = torch.zeros(depth, height, width, dtype=torch.bool)
            for corner in range(8):
                x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
                nodes[z : depth - 1 + z, y : height - 1 + y, x : width - 1 + x] |= covered
            wanted.append(nodes.reshape(-1))
        new = (torch.cat(wanted).to(self.rows.device) & (self.rows < 0)).nonzero()[:, 0]
        if len(new):
            self.rows[new] = torch.arange(len(self.table), len(self.table) + len(new), dtype=torch.int32, device=new.device)
            fresh = self.table.new_empty(len(new), self.features).uniform_(-_START, _START)
            self.table = nn.Parameter(torch.cat([self.table.detach(), fresh]))
        return len(new)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        """Take over a table of another length, as one has that was covered differently."""
        table = state_dict.get(prefix + "table")
        if isinstance(table, Tensor) and table.ndim == 2 and table.shape[1] == self.features:
            self.table = nn.Parameter(self.table.new_empty(table.shape))
        super()._load_from_state_dict(state_dict, prefix, *arguments)
        if len(self.rows) and int(self.rows.min()) < -1:
            arguments[-1].append(f"{prefix}rows: wanted rows from -1, got {int(self.rows.min())}")
        if len(self.rows) and int(self.rows.max()) >= len(self.table):
            arguments[-1].append(
                f"{prefix}rows names {int(self.rows.max()) + 1} rows of features, {prefix}table has {len(self.table)}"
            )


def _overlaps(coarse: int, fine: int) -> Tensor:
    """Return which of `coarse` equal parts of a side overlap each of its `fine` parts, 0 or 1, [fine, coarse]."""
    first, second = torch.arange(fine)[:, None], torch.arange(coarse)
    return ((first * coarse < (second + 1) * fine) & (second * fine < (first + 1) * coarse)).float()
