"""Sets of grid cells to search."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.segments import distance_to_segments

__all__ = ["cells_near", "corners_of"]

_SEGMENTS_AT_ONCE = 256
_NODES_AT_ONCE = 2**16


def cells_near(grid: CanonicalGrid, shape: tuple[int, int, int], places: list[tuple[Tensor, float]]) -> Tensor:
    """Return whether cells have a corner near one of several places, [D-1, H-1, W-1], bool.

    Args:
        grid: canonical box.
        shape: nodes (D, H, W).
        places: pairs of segments [S, 2, 3] or points [S, 3], metres, and the largest distance that counts as near, metres.
    """
    nodes = grid.nodes(shape).reshape(-1, 3)
    near = torch.zeros(len(nodes), dtype=torch.bool, device=nodes.device)
    for content, radius in places:
        for some in content.split(_SEGMENTS_AT_ONCE):  # both bound the memory
            for part, part_near in zip(nodes.split(_NODES_AT_ONCE), near.split(_NODES_AT_ONCE), strict=True):
                distance = distance_to_segments(part, some) if some.ndim == 3 else torch.cdist(part, some).amin(1)
                part_near |= distance < radius
    return torch.nn.functional.max_pool3d(near.reshape(1, 1, *shape).float(), 2, stride=1)[0, 0] > 0


def corners_of(cells: Tensor) -> Tensor:
    """Return whether nodes are corners of the given cells [D-1, H-1, W-1], [D, H, W], bool."""
    used = cells.new_zeros([n + 1 for n in cells.shape])
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2 & 1
        used[z : z + cells.shape[0], y : y + cells.shape[1], x : x + cells.shape[2]] |= cells
    return used
