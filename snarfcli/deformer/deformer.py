"""The forward-skinning module: a weight field on a grid, posed points in, canonical correspondences out."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from snarfcli.deformer.complete import posed_cell_boxes
from snarfcli.deformer.correspondences import Correspondences, find_correspondences
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate
from snarfcli.deformer.search import SearchConfig
from snarfcli.deformer.skinning import blend_transforms, interpolate, skin
from snarfcli.deformer.weights import BonePrior, DistilledWeights
from snarfcli.segments import distance_to_segments

__all__ = ["ForwardDeformer", "SkinningConfig", "cells_near"]


@dataclass
class SkinningConfig:
    name: str = "distilled"
    """Weight field: distilled (a network evaluated at the grid nodes)."""
    resolution: list[int] = field(default_factory=lambda: [64, 64, 16])
    """Grid nodes along x, y, z."""
    margin_m: list[float] = field(default_factory=lambda: [0.12, 0.12, 0.20])
    """What the grid's box adds around the canonical body on either side, along x, y, z, metres."""
    bone_radius_m: float | None = 0.22
    """Cells with a corner this near to a bone are searched, metres; null searches every cell."""
    surface_radius_m: float = 0.12
    """So are cells this near to the rough canonical surface that the grid's box was made from, metres."""
    width: int = 128
    """Width of the network's hidden layers."""
    depth: int = 4
    """Number of hidden layers."""
    sharpness: float = 20.0
    """Factor before the softmax over the bones."""
    weight_norm: bool = True
    """Whether the network's layers are weight-normalised."""
    prior_falloff_m: float | None = None
    """The network corrects weights that fall by a factor e over this distance to a bone, metres; null for no such prior."""


class ForwardDeformer(nn.Module):
    """Find the canonical correspondences of posed points under learned forward skinning.

    Args:
        grid: canonical box of the weight grid.
        num_bones: J, the number of bone transforms.
        skinning: the weight field.
        search: how correspondences are found.
        active_cells: bool [D-1, H-1, W-1], the cells that a complete search looks into (see `cells_near`); None for all.
        prior: weights that the field only corrects.
    """

    def __init__(
        self,
        grid: CanonicalGrid,
        num_bones: int,
        skinning: SkinningConfig | None = None,
        search: SearchConfig | None = None,
        active_cells: Tensor | None = None,
        prior: BonePrior | None = None,
    ) -> None:
        super().__init__()
        skinning = skinning or SkinningConfig()
        self.search = search or SearchConfig()
        self.num_bones = num_bones
        width, height, depth = skinning.resolution
        self.shape = (depth, height, width)
        self.field = DistilledWeights(
            num_bones, grid, skinning.width, skinning.depth, skinning.sharpness, skinning.weight_norm, prior
        )
        self.register_buffer("lower", grid.lower.clone())
        self.register_buffer("upper", grid.upper.clone())
        if active_cells is None:
            active_cells = torch.ones([n - 1 for n in self.shape], dtype=torch.bool)
        self.register_buffer("active_cells", active_cells.clone())
        self._frozen: Tensor | None = None

    @property
    def grid(self) -> CanonicalGrid:
        """The box of the weight grid."""
        return CanonicalGrid(self.lower, self.upper)

    def weight_grid(self) -> Tensor:
        """Return the skinning weights at the grid nodes, [D, H, W, J].

        In training with a complete search only the nodes of active cells are evaluated; the others are never read.
        """
        if self._frozen is not None:
            return self._frozen
        nodes = self.grid.nodes(self.shape).reshape(-1, 3)
        if not (self.training and self.search.name == "complete"):
            return self.field(nodes).reshape(*self.shape, -1)
        used = cell_corners(self.active_cells.reshape(-1).nonzero()[:, 0], self.shape).unique()
        weights = nodes.new_zeros(len(nodes), self.num_bones).index_copy(0, used, self.field(nodes[used]))
        return weights.reshape(*self.shape, -1)

    def freeze(self) -> ForwardDeformer:
        """Evaluate the weight grid once and keep it; call this after training. `train()` undoes it."""
        self.eval()
        self._frozen = None
        with torch.no_grad():
            self._frozen = self.weight_grid()
        return self

    def train(self, mode: bool = True) -> ForwardDeformer:
        """Switch between training and evaluation; either way a frozen weight grid is forgotten."""
        self._frozen = None
        return super().train(mode)

    def _apply(self, fn, recurse=True):
        self._frozen = None
        return super()._apply(fn, recurse)

    def forward(self, points: Tensor, bone_transforms: Tensor) -> Correspondences:
        """Find the correspondences of posed points [B, N, 3] under bone transforms [B, J, 4, 4], canonical to posed."""
        complete = self.search.name == "complete"
        return find_correspondences(
            points,
            bone_transforms,
            self.weight_grid(),
            self.grid,
            search=self.search.name,
            init_bones=self.search.init_bones,
            active_cells=self.active_cells if complete else None,
            tolerance=self.search.tolerance,
            max_steps=self.search.max_steps,
            divergence=self.search.divergence,
            jacobian=self.search.jacobian,
        )

    def is_active(self, canonical: Tensor) -> Tensor:
        """Return which canonical points [N, 3] lie in cells that a complete search looks into, bool [N]."""
        cell, local = locate(canonical, self.grid, self.shape)
        return ((local >= 0) & (local <= 1)).all(1) & self.active_cells.reshape(-1)[cell]

    def posed_box(self, bone_transforms: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box around the images of `cells` in one pose, metres.

        Args:
            bone_transforms: [J, 4, 4], canonical to posed.
            cells: bool [D-1, H-1, W-1], at least one.
        """
        corners = cell_corners(cells.reshape(-1).nonzero()[:, 0], self.shape)
        origins = self.grid.nodes(self.shape).reshape(-1, 3)[corners[:, 0]]
        transforms = blend_transforms(self.weight_grid(), bone_transforms[None])[0][corners]
        lower, upper = posed_cell_boxes(transforms, origins, self.grid.cell_size(self.shape))
        return lower.amin(0).cpu(), upper.amax(0).cpu()

    def skinning_weights(self, canonical: Tensor) -> Tensor:
        """Return the grid's skinning weights [N, J] at canonical points [N, 3]."""
        return interpolate(self.weight_grid(), canonical, self.grid)

    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Move canonical points [N, 3] into one pose [J, 4, 4]; the exact inverse of the search on the grid."""
        return skin(canonical, self.skinning_weights(canonical), bone_transforms)


def cells_near(grid: CanonicalGrid, shape: tuple[int, int, int], places: list[tuple[Tensor, float]]) -> Tensor:
    """Return which cells have a corner near one of several places, bool [D-1, H-1, W-1].

    Args:
        grid: canonical box.
        shape: nodes (D, H, W).
        places: segments [S, 2, 3], metres, each with the distance that still counts as near, metres. A point is a segment
            of no length.
    """
    nodes = grid.nodes(shape).reshape(-1, 3)
    near = torch.zeros(len(nodes), dtype=torch.bool, device=nodes.device)
    for segments, radius in places:
        for some in segments.split(256):  # bounds the memory
            near |= distance_to_segments(nodes, some) < radius
    return torch.nn.functional.max_pool3d(near.reshape(1, 1, *shape).float(), 2, stride=1)[0, 0] > 0
