"""Boxes in posed space around the images of grid cells."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.deformer.cell_polynomials import bound_boxes, cell_polynomials
from snarfcli.deformer.grid import CanonicalGrid, cell_corners

__all__ = ["polynomial_boxes", "posed_boxes", "posed_cell_boxes"]

_CELLS_AT_ONCE = 65_536  # bounds the memory: 400 bytes of corner transforms per cell, and as much per intermediate result


def posed_cell_boxes(corner_transforms: Tensor, origins: Tensor, cell_size: Tensor) -> tuple[Tensor, Tensor]:
    """Return posed-space boxes (lower [C, 3], upper [C, 3]) that contain the image of each cell, metres.

    Args:
        corner_transforms: [C, 8, 12], blended transforms at the corners of the cells.
        origins: [C, 3], canonical position of each cell's first corner, metres.
        cell_size: [3], metres.
    """
    lower, upper = polynomial_boxes(cell_polynomials(corner_transforms, (origins + cell_size / 2).T, cell_size))
    return lower.T, upper.T


def posed_boxes(transforms: Tensor, grid: CanonicalGrid, shape: Sequence[int], active_cells: Tensor | None = None) -> Tensor:
    """Return the lower and upper corner of a box around the images of cells in each pose, [B, 2, 3], metres.

    Args:
        transforms: [B, D * H * W, 12], blended transforms at the nodes.
        grid: the box of the nodes.
        shape: nodes (D, H, W).
        active_cells: [D-1, H-1, W-1], bool; None for all.
    """
    depth, height, width = shape
    cells = (torch.ones(depth - 1, height - 1, width - 1) if active_cells is None else active_cells).reshape(-1)
    corners = cell_corners(cells.nonzero()[:, 0].to(transforms.device), shape)
    origins = grid.nodes(shape).reshape(-1, 3)[corners[:, 0]]
    boxes = []
    for one in transforms:
        parts = [
            posed_cell_boxes(one[some], places, grid.cell_size(shape))
            for some, places in zip(corners.split(_CELLS_AT_ONCE), origins.split(_CELLS_AT_ONCE), strict=True)
        ]
        lower, upper = (torch.cat(sides) for sides in zip(*parts, strict=True))
        boxes.append(torch.stack([lower.amin(0), upper.amax(0)]))
    return torch.stack(boxes) if boxes else transforms.new_empty(0, 2, 3)


def polynomial_boxes(polynomials: Tensor) -> tuple[Tensor, Tensor]:
    """Return the boxes (lower [3, C], upper [3, C]) of cells."""
    centre, half = polynomials[0, 0, 0], bound_boxes(polynomials)
    return centre - half, centre + half
