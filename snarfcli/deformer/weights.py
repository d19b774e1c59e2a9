"""Weight fields: where the skinning weights at the grid nodes come from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.segments import segment_distances

__all__ = ["BonePrior", "DistilledWeights"]


class BonePrior(nn.Module):
    """Logits of skinning weights that fall with the distance to each bone: what a skeleton alone says of them.

    At a joint its own bone and its parent's are equally near, which is the value that SNARF Sec. 3.3 asks for there.

    Args:
        segments: ends of the bones' segments, [S, 2, 3], canonical frame, metres.
        owner: which bone each segment belongs to, S numbers; every bone needs one.
        num_bones: J.
        falloff: distance over which a weight falls by a factor e, metres.
    """

    def __init__(self, segments: Tensor, owner: Sequence[int], num_bones: int, falloff: float) -> None:
        super().__init__()
        self.num_bones, self.falloff = num_bones, falloff
        self.register_buffer("segments", segments.clone())
        self.register_buffer("owner", torch.tensor(list(owner)))

    def forward(self, canonical: Tensor) -> Tensor:
        """Return logits [N, J] at canonical points [N, 3], metres."""
        distances = segment_distances(canonical, self.segments)
        owner = self.owner.expand(len(canonical), -1)
        start = distances.new_full((len(canonical), self.num_bones), torch.inf)
        return start.scatter_reduce(1, owner, distances, "amin") / -self.falloff


class DistilledWeights(nn.Module):
    """Skinning weights as a small network that is evaluated at the grid nodes (Fast-SNARF Sec. 4.2).

    The network makes the field smooth; the search only ever sees its values at the nodes.

    Args:
        num_bones: J.
        grid: its box; coordinates are scaled to [-1, 1] in it before they enter the network.
        width, depth: size of the hidden layers and their number.
        sharpness: factor before the softmax over the bones (20 in the released Fast-SNARF).
        weight_norm: whether the layers are weight-normalised, as in the papers.
        prior: logits that the network only corrects; the field then starts as the prior alone.
    """

    def __init__(
        self,
        num_bones: int,
        grid: CanonicalGrid,
        width: int,
        depth: int,
        sharpness: float,
        weight_norm: bool,
        prior: BonePrior | None = None,
    ) -> None:
        super().__init__()
        sizes = [3] + [width] * depth + [num_bones]
        layers = [nn.Linear(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        if prior is not None:
            nn.init.normal_(layers[-1].weight, 0, 1e-4)
            nn.init.zeros_(layers[-1].bias)
        if weight_norm:
            layers = [nn.utils.parametrizations.weight_norm(layer) for layer in layers]
        self.layers = nn.ModuleList(layers)
        self.sharpness = sharpness
        self.prior = prior
        self.register_buffer("centre", (grid.lower + grid.upper) / 2, persistent=False)
        self.register_buffer("half_extent", (grid.upper - grid.lower) / 2, persistent=False)

    def forward(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3], rows sum to 1."""
        h = (canonical - self.centre) / self.half_extent
        for layer in self.layers[:-1]:
            h = nn.functional.softplus(layer(h), beta=100)
        logits = self.sharpness * self.layers[-1](h)
        if self.prior is not None:
            logits = logits + self.prior(canonical)
        return torch.softmax(logits, dim=-1)
