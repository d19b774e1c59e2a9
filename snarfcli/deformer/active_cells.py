"""The cells of a grid that a search looks into, and what follows from them."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from snarfcli.deformer.cells import corners_of
from snarfcli.deformer.grid import CanonicalGrid, locate
from snarfcli.draws import Draws

__all__ = ["ActiveCells"]


class ActiveCells(nn.Module):
    """A canonical box divided into cells, some of which are active.

    Args:
        grid: canonical box.
        shape: nodes (D, H, W).
        active_cells: [D-1, H-1, W-1], bool, see `set_active_cells`; None for all.
    """

    lower: Tensor
    upper: Tensor
    active_cells: Tensor
    """[D-1, H-1, W-1], bool, the cells that a complete search looks into; see `set_active_cells`."""
    _used_nodes: Tensor
    _active_nodes: Tensor
    _active_points: Tensor
    _active_places: Tensor
    _active_count: Tensor
    searches_all_cells: bool
    """Whether all cells are active."""

    def __init__(self, grid: CanonicalGrid, shape: tuple[int, int, int], active_cells: Tensor | None) -> None:
        super().__init__()
        self.shape = shape
        self.register_buffer("lower", grid.lower.clone())
        self.register_buffer("upper", grid.upper.clone())
        self.register_buffer("active_cells", torch.ones([n - 1 for n in self.shape], dtype=torch.bool))
        self.register_buffer("_used_nodes", torch.empty(0, dtype=torch.bool), persistent=False)
        self.register_buffer("_active_nodes", torch.empty(0, dtype=torch.long), persistent=False)
        self.register_buffer("_active_points", torch.empty(0, 3), persistent=False)
        self.register_buffer("_active_places", torch.empty(0, 3, dtype=torch.long), persistent=False)
        self.register_buffer("_active_count", torch.empty(0, dtype=torch.long), persistent=False)
        self._keeps_room = False
        self.set_active_cells(self.active_cells if active_cells is None else active_cells)

    @property
    def grid(self) -> CanonicalGrid:
        """The box of the weight grid."""
        return CanonicalGrid(self.lower, self.upper, checked=True)

    @property
    def _renews_points(self) -> bool:
        """Whether the tensor of active points is replaced when they change, since something is kept for it."""
        return False

    def set_active_cells(self, cells: Tensor) -> None:
        """Choose the cells that a complete search looks into, [D-1, H-1, W-1], bool; they are saved with the state.

        Waits for a GPU, so that a search need not.

        Raises:
            ValueError: the shape or dtype differs, or no cell is left.
        """
        self._check_cells("active_cells", cells)
        if not bool(cells.any()):
            raise ValueError("active_cells: wanted at least one cell, got none")
        self.active_cells.copy_(cells)
        self._update_active_nodes()

    def _check_cells(self, name: str, cells: Tensor) -> None:
        wanted = [n - 1 for n in self.shape]
        if not isinstance(cells, Tensor) or list(cells.shape) != wanted or cells.dtype != torch.bool:
            came = f"{cells.dtype} {list(cells.shape)}" if isinstance(cells, Tensor) else type(cells).__name__
            raise ValueError(f"{name}: wanted bool {wanted}, got {came}")

    def _update_active_nodes(self) -> None:
        """Keep which nodes active cells have, flat indices [K] and positions [K, 3]: finding them waits for a GPU.

        With room for more, the indices beyond are those of no node, D * H * W and more.
        """
        self.searches_all_cells = bool(self.active_cells.all())
        used = corners_of(self.active_cells)
        nodes, places = used.reshape(-1).nonzero()[:, 0], self.active_cells.nonzero()
        points = self.grid.nodes(self.shape).reshape(-1, 3)[nodes]
        count = torch.full((1,), len(places), device=places.device)
        if not self._keeps_room:
            self._used_nodes, self._active_nodes, self._active_points = used, nodes, points
            self._active_places, self._active_count = places, count
            return
        self._used_nodes.copy_(used)
        self._active_count.copy_(count)
        self._active_nodes = _fill(self._active_nodes, nodes, math.prod(self.shape))
        # All different, so that a GPU which sums gradients of their rows does not queue at one of them.
        self._active_nodes[len(nodes) :] += torch.arange(len(self._active_nodes) - len(nodes), device=nodes.device)
        self._active_places = _fill(self._active_places, places, 0)
        kept = self._active_points[:0] if self._renews_points else self._active_points
        self._active_points = _fill(kept, points, 0, len(self._active_nodes))

    def keep_room(self) -> None:
        """Keep the tensors that follow from the active cells in their places, with room for a quarter more.

        So a captured step stays valid when cells change. Tensors that outgrow their room are replaced by longer ones.
        """
        if not self._keeps_room:
            self._keeps_room = True
            self._active_nodes, self._active_places = self._active_nodes[:0], self._active_places[:0]
            self._active_points = self._active_points[:0]
            self._update_active_nodes()

    def is_active(self, canonical: Tensor) -> Tensor:
        """Return whether canonical points [N, 3] lie in cells that a complete search looks into, [N], bool."""
        cell, local = locate(canonical, self.grid, self.shape)
        return ((local >= 0) & (local <= 1)).all(1) & self.active_cells.reshape(-1)[cell]

    def random_canonical(self, count: int, draws: Draws) -> Tensor:
        """Return canonical points [count, 3] spread evenly over the active cells, metres."""
        chosen = draws.integers(self._active_count if self._keeps_room else len(self._active_places), count)
        places = draws.uniform(count, 3).to(self.lower)
        return self.lower + (self._active_places[chosen].flip(1) + places) * self.grid.cell_size(self.shape)


def _fill(kept: Tensor, values: Tensor, empty: int, length: int | None = None) -> Tensor:
    """Return `kept` with values [K, ...] as its first rows and `empty` in the others; a longer tensor if it is too short.

    Args:
        length: of the longer tensor; None for a quarter more than K.
    """
    if len(kept) < len(values):
        kept = values.new_empty(length or len(values) + len(values) // 4, *values.shape[1:])
    kept[: len(values)] = values
    kept[len(values) :] = empty
    return kept
