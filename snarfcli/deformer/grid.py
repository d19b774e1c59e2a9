"""The canonical voxel grid: the positions of its nodes, and trilinear interpolation between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass

import torch
from torch import Tensor

from snarfcli.constants import constant
from snarfcli.field_docs import documented

__all__ = ["CORNERS", "CanonicalGrid", "cell_corners", "locate", "trilinear_weights"]

# Corner k of a cell lies at (k & 1, k >> 1 & 1, k >> 2 & 1) along (x, y, z).
CORNERS = torch.tensor([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])


@documented
@dataclass(frozen=True)
class CanonicalGrid:
    """An axis-aligned box in canonical space whose outermost grid nodes lie on its corners.

    The number of nodes is not kept here: it is the shape [D, H, W] (z, y, x) of the array that is laid over the box.
    """

    lower: Tensor
    """[3], corner with the smallest coordinates, metres."""
    upper: Tensor
    """[3], corner with the largest coordinates, metres."""
    checked: InitVar[bool] = False
    """Whether the corners have been checked already; a check forces a synchronisation on a GPU."""

    def __post_init__(self, checked: bool) -> None:
        if checked:
            return
        for name in ("lower", "upper"):
            if not isinstance(getattr(self, name), Tensor):
                raise TypeError(f"grid.{name}: wanted a tensor [3], got a {type(getattr(self, name)).__name__}")
            if tuple(getattr(self, name).shape) != (3,):
                raise ValueError(f"grid.{name}: wanted shape [3], got {list(getattr(self, name).shape)}")
        if not bool((self.upper > self.lower).all()):
            raise ValueError(f"grid.upper: wanted more than grid.lower, got {self.upper.tolist()} and {self.lower.tolist()}")

    @classmethod
    def around(cls, points: Tensor, margin: Sequence[float]) -> CanonicalGrid:
        """Return the box of `points` [N, 3] widened by `margin` (x, y, z) on either side, metres."""
        widen = torch.as_tensor(margin, dtype=points.dtype, device=points.device)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or widen.shape != (3,):
            shapes = f"{list(points.shape)} and {list(widen.shape)}"
            raise ValueError(f"points, margin: wanted shapes [N, 3], at least one point, and [3], got {shapes}")
        return cls(points.amin(0) - widen, points.amax(0) + widen)

    @property
    def longest_side(self) -> float:
        """Length of the longest side, metres."""
        return float((self.upper - self.lower).max())

    def to(self, like: Tensor) -> CanonicalGrid:
        """Return the same box with the dtype and on the device of `like`."""
        return CanonicalGrid(self.lower.to(like), self.upper.to(like), checked=True)

    def cell_size(self, shape: Sequence[int]) -> Tensor:
        """Return the sides of one cell along x, y, z, [3], metres, for nodes laid out as `shape` = (D, H, W)."""
        return (self.upper - self.lower) / _cells_along(shape, self.lower.device, self.lower.dtype)

    def nodes(self, shape: Sequence[int]) -> Tensor:
        """Return the canonical positions of the nodes, [D, H, W, 3], metres."""
        axes = [torch.linspace(0, 1, n, dtype=self.lower.dtype, device=self.lower.device) for n in shape]
        z, y, x = torch.meshgrid(*axes, indexing="ij")
        return self.lower + torch.stack([x, y, z], -1) * (self.upper - self.lower)


def cell_corners(cells: Tensor, shape: Sequence[int]) -> Tensor:
    """Return the flat node indices [..., 8] of the corners of `cells`, given as flat cell indices [...].

    Cells are numbered x fastest in a (D-1, H-1, W-1) array, nodes x fastest in `shape` = (D, H, W).
    """
    _depth, height, width = shape
    x = cells % (width - 1)
    y = cells // (width - 1) % (height - 1)
    z = cells // ((width - 1) * (height - 1))
    first = (z * height + y) * width + x
    offsets = [((k >> 2) * height + (k >> 1 & 1)) * width + (k & 1) for k in range(8)]
    return first[..., None] + constant(offsets, cells.device)


def locate(points: Tensor, grid: CanonicalGrid, shape: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the flat cell index [N] that holds each canonical point [N, 3], and its coordinates [N, 3] in that cell.

    Coordinates run from 0 to 1 inside a cell; a point outside the grid gets the nearest cell and coordinates beyond.
    """
    cells = _cells_along(shape, points.device, torch.int64)
    scaled = (points - grid.lower) / grid.cell_size(shape)
    index = scaled.detach().floor().long().clamp_min(0).minimum(cells - 1)
    return (index[..., 2] * cells[1] + index[..., 1]) * cells[0] + index[..., 0], scaled - index


def _cells_along(shape: Sequence[int], device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the numbers of cells along x, y, z, [3], between nodes laid out as `shape` = (D, H, W)."""
    return constant([shape[2] - 1, shape[1] - 1, shape[0] - 1], device, dtype)


def trilinear_weights(local: Tensor) -> Tensor:
    """Return the weights [..., 8] of a cell's corners at coordinates `local` [..., 3] in the cell."""
    x, y, z = local.unbind(-1)
    x0, y0, z0 = 1 - x, 1 - y, 1 - z
    xy = torch.stack([x0 * y0, x * y0, x0 * y, x * y], -1)
    return torch.cat([xy * z0[..., None], xy * z[..., None]], -1)
