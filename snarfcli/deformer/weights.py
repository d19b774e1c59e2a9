"""Weight fields: where the skinning weights at the grid nodes come from."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from snarfcli.deformer.grid import CanonicalGrid

__all__ = ["DistilledWeights"]


class DistilledWeights(nn.Module):
    """Skinning weights as a small network that is evaluated at the grid nodes (Fast-SNARF Sec. 4.2).

    The network makes the field smooth; the search only ever sees its values at the nodes.

    Args:
        num_bones: J.
        grid: its box; coordinates are scaled to [-1, 1] in it before they enter the network.
        width, depth: size of the hidden layers and their number.
        sharpness: factor before the softmax over the bones (20 in the released Fast-SNARF).
        weight_norm: whether the layers are weight-normalised, as in the papers.
    """

    def __init__(
        self, num_bones: int, grid: CanonicalGrid, width: int, depth: int, sharpness: float, weight_norm: bool
    ) -> None:
        super().__init__()
        sizes = [3] + [width] * depth + [num_bones]
        layers = [nn.Linear(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        if weight_norm:
            layers = [nn.utils.parametrizations.weight_norm(layer) for layer in layers]
        self.layers = nn.ModuleList(layers)
        self.sharpness = sharpness
        self.register_buffer("centre", (grid.lower + grid.upper) / 2, persistent=False)
        self.register_buffer("half_extent", (grid.upper - grid.lower) / 2, persistent=False)

    def forward(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3], rows sum to 1."""
        h = (canonical - self.centre) / self.half_extent
        for layer in self.layers[:-1]:
            h = nn.functional.softplus(layer(h), beta=100)
        return torch.softmax(self.sharpness * self.layers[-1](h), dim=-1)
