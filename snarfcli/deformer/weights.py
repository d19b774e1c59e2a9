"""Weight fields: skinning weights as functions of canonical points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from snarfcli.deformer.bone_prior import BonePrior
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.deformer.harmonic import harmonic
from snarfcli.deformer.hierarchy import HierarchicalSoftmax, PlainSoftmax
from snarfcli.deformer.trilinear import interpolate
from snarfcli.field_docs import documented
from snarfcli.networks import ACTIVATIONS, WeightNormLinear, run_perceptron

__all__ = ["GridWeights", "NetworkWeights", "NodeWeights", "VoxelWeights", "WeightField"]

_SHARPNESS_OF_SOFTPLUS = 100.0  # as in the papers' code
_LEAST_WEIGHT = 1e-9  # so that every weight has a finite logit; the sum stays 1 in float32
_SOLVED = 1e-3  # steps of Adam change weights by more


class WeightField(nn.Module):
    """Interface of a weight field.

    A field is called with canonical points [N, 3], metres, and returns weights [N, J], non-negative, rows sum to 1. Each row
    depends on its point only. `ForwardDeformer` accepts any other callable of this kind as well.
    """

    def set_box(self, grid: CanonicalGrid) -> None:
        """Update the canonical box, after the deformer has loaded another from a state."""


@documented
@dataclass(frozen=True)
class NodeWeights:
    """Skinning weights at the grid nodes, evaluated once and used by a search and by what follows it."""

    values: Tensor
    """[D, H, W, J], or [B, D, H, W, J] for weights that differ from pose to pose; where only nodes of active cells were
    evaluated, the others are zero."""
    grid: CanonicalGrid
    """The box of the nodes."""

    def at(self, canonical: Tensor, pose_index: Tensor | None = None) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3], trilinear between the nodes.

        Args:
            canonical: [N, 3], metres; points outside the box get the weights of its border.
            pose_index: [N], the pose of each point, for weights that differ from pose to pose.
        """
        if canonical.ndim != 2 or canonical.shape[1] != 3:
            raise ValueError(f"canonical: wanted shape [N, 3], got {list(canonical.shape)}")
        if self.values.ndim == 4:
            return interpolate(self.values, canonical, self.grid)
        corners, local = self.corners(canonical, pose_index)
        return (trilinear_weights(local.clamp(0, 1))[..., None] * corners).sum(-2)

    def corners(self, canonical: Tensor, pose_index: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the weights [N, 8, J] at the corners of each point's cell, and its coordinates [N, 3] in the cell.

        Coordinates are beyond 0 to 1 for points outside the box.
        """
        shape = self.values.shape[-4:-1]
        cell, local = locate(canonical, self.grid, shape)
        corners = cell_corners(cell, shape)
        if self.values.ndim == 5:
            if pose_index is None:
                raise ValueError(
                    "pose_index: wanted the pose of each point, for weights that differ from pose to pose, got None"
                )
            corners = corners + math.prod(shape) * pose_index[:, None]
        return self.values.reshape(-1, self.values.shape[-1])[corners], local


class NetworkWeights(WeightField):
    """Skinning weights as a small network.

    Evaluated at the grid nodes it makes the field smooth, and the search only sees its values at the nodes (Fast-SNARF
    Sec. 4.2); searched directly it is SNARF's field (SNARF Eq. 3).

    Args:
        softmax: from logits to weights; determines the number of logits.
        grid: its box; coordinates are scaled to [-1, 1] in it before they enter the network.
        width: width of the hidden layers.
        depth: number of hidden layers.
        sharpness: factor before the softmax over the bones (20 in the released Fast-SNARF).
        weight_norm: whether the layers are weight-normalised, as in the papers.
        prior: logits of a plain softmax that the network only corrects; the field then starts as the prior.
    """

    def __init__(
        self,
        softmax: PlainSoftmax | HierarchicalSoftmax,
        grid: CanonicalGrid,
        width: int,
        depth: int,
        sharpness: float,
        weight_norm: bool,
        prior: BonePrior | None = None,
    ) -> None:
        super().__init__()
        sizes = [3] + [width] * depth + [softmax.num_logits]
        layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
        if prior is not None:
            nn.init.normal_(layers[-1].weight, 0, 1e-4)
            nn.init.zeros_(layers[-1].bias)
        if weight_norm:
            layers = [WeightNormLinear(layer) for layer in layers]
        self.layers = nn.ModuleList(layers)
        self.softmax = softmax
        self.sharpness = sharpness
        self.prior = prior
        self._last: tuple[Tensor, Tensor] | None = None  # points, and the logits of the prior there, see `at_fixed_points`
        self.register_buffer("centre", torch.empty(0), persistent=False)
        self.register_buffer("half_extent", torch.empty(0), persistent=False)
        self.set_box(grid)

    def set_box(self, grid: CanonicalGrid) -> None:
        """Scale coordinates by a new box."""
        self.centre, self.half_extent = (grid.lower + grid.upper) / 2, (grid.upper - grid.lower) / 2

    def forward(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3], rows sum to 1."""
        h = (canonical - self.centre) / self.half_extent
        for layer in self.layers[:-1]:
            h = nn.functional.softplus(layer(h), beta=_SHARPNESS_OF_SOFTPLUS)
        prior = None if self.prior is None else self.softmax.invert(self.prior(canonical))
        return self._weights(self.layers[-1](h), prior)

    @property
    def most_values(self) -> int:
        """Largest number of values per point of any layer, of the weights and of the prior."""
        segments = 0 if self.prior is None else len(self.prior.segments)
        widths = [layer.out_features for layer in self.layers if isinstance(layer, nn.Linear)]
        return max(*widths, self.softmax.num_bones, segments)

    def at_fixed_points(self, canonical: Tensor, keeps_prior: bool) -> Tensor:
        """Return the same as `forward`, several times faster on a CPU.

        There are no second derivatives, which a search in the field itself needs.

        Args:
            canonical: [N, 3], metres.
            keeps_prior: whether to keep the prior at these points, for the same tensor in the next step, instead of that at
                others. It stays at its place in memory as long as the tensor does, which captured CUDA graphs rely on.
        """
        first = (canonical - self.centre) / self.half_extent
        linears = [layer for layer in self.layers if isinstance(layer, nn.Linear)]
        weights, biases = [layer.weight for layer in linears], [layer.bias for layer in linears]
        takes_first, takes_extras = [1] + [0] * (len(weights) - 1), [0] * len(weights)
        settings = (takes_first, takes_extras, ACTIVATIONS["softplus"], _SHARPNESS_OF_SOFTPLUS)
        prior = None if self.prior is None else self._prior_at(canonical, keeps_prior)
        return self._weights(run_perceptron(first, None, weights, biases, *settings), prior)

    def _weights(self, outputs: Tensor, prior: Tensor | None) -> Tensor:
        """Return the weights [N, J] for the outputs of the network and the logits of the prior, [N, num_logits] each."""
        logits = self.sharpness * outputs
        return self.softmax(logits if prior is None else logits + prior)

    def _prior_at(self, canonical: Tensor, keeps: bool) -> Tensor:
        """Return the logits of the prior, those that are kept if they are for this tensor of points."""
        assert self.prior is not None
        last = self._last  # in one piece, since another thread may replace it
        if last is None or last[0] is not canonical:
            last = canonical, self.softmax.invert(self.prior(canonical)).detach()
            if keeps:
                self._last = last
        return last[1]


class GridWeights(WeightField):
    """Weights that are defined at the grid nodes and trilinear between them.

    Args:
        grid: its box.
        shape: nodes (D, H, W).
    """

    def __init__(self, grid: CanonicalGrid, shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.shape = shape
        self.register_buffer("lower", grid.lower.clone(), persistent=False)
        self.register_buffer("upper", grid.upper.clone(), persistent=False)

    def set_box(self, grid: CanonicalGrid) -> None:
        """Lay the nodes over a new box."""
        self.lower, self.upper = grid.lower.clone(), grid.upper.clone()

    def at_nodes(self, nodes: Tensor | None = None) -> Tensor:
        """Return the weights [..., J] at the nodes with flat indices [...], or of all nodes, [D * H * W, J]."""
        raise NotImplementedError

    def forward(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3]; outside the box, those of its border."""
        cell, local = locate(canonical, CanonicalGrid(self.lower, self.upper, checked=True), self.shape)
        phi = trilinear_weights(local.clamp(0, 1))
        return (phi[..., None] * self.at_nodes(cell_corners(cell, self.shape))).sum(-2)


class VoxelWeights(GridWeights):
    """Weights that are optimised directly at the grid nodes.

    Fast-SNARF Sec. 4.2 mentions this field, with a total-variation loss (`total_variation`), and reports that the distilled one
    is smoother and more accurate.

    Args:
        softmax: from logits to weights.
        grid: its box.
        shape: nodes (D, H, W).
        sharpness: factor before the softmax, which makes steps of the optimiser as large as those of the distilled field.
        prior: logits of a plain softmax to start from; without it all weights are equal at first.
        mirror: [J], the bone to which the plane through the middle of the box, across x, maps each. Weights at mirrored places
            are then the same, for mirrored bones, and only those at the nodes with x below the middle are optimised. None for
            no symmetry.
    """

    _mirror: Tensor

    def __init__(
        self,
        softmax: PlainSoftmax | HierarchicalSoftmax,
        grid: CanonicalGrid,
        shape: tuple[int, int, int],
        sharpness: float,
        prior: BonePrior | None = None,
        mirror: Sequence[int] | None = None,
    ) -> None:
        super().__init__(grid, shape)
        self.softmax = softmax
        self.sharpness = sharpness
        self.is_symmetric = mirror is not None
        self.register_buffer("_mirror", torch.tensor(list(mirror or ())), persistent=False)
        self.columns = (shape[2] + 1) // 2 if self.is_symmetric else shape[2]
        """Number of nodes along x at which weights are optimised."""
        nodes = self.optimised(grid.nodes(shape)).reshape(-1, 3)
        start = nodes.new_zeros(len(nodes), softmax.num_logits) if prior is None else softmax.invert(prior(nodes)) / sharpness
        self.logits = nn.Parameter(start.detach().clone())

    def optimised(self, values: Tensor) -> Tensor:
        """Return those of values [D, H, W, ...] at all nodes that are at optimised ones, [D, H, columns, ...]."""
        return values[:, :, : self.columns]

    def at_nodes(self, nodes: Tensor | None = None) -> Tensor:
        """Return the weights [..., J] at the nodes with flat indices [...], or of all nodes, [D * H * W, J]."""
        if nodes is None and not self.is_symmetric:
            return self.softmax(self.sharpness * self.logits)
        nodes = torch.arange(math.prod(self.shape), device=self.logits.device) if nodes is None else nodes
        flat = nodes.reshape(-1)
        if not self.is_symmetric:
            return self._weights_of(flat).reshape(*nodes.shape, -1)
        last = self.shape[2] - 1
        row = torch.div(flat, last + 1, rounding_mode="floor")
        column = flat - row * (last + 1)
        weights = self._weights_of(row * self.columns + torch.minimum(column, last - column))
        # At nodes in the plane, if there are any, the weights are those of neither side.
        share = (0.5 + 0.5 * torch.sign(2 * column - last))[:, None].to(weights)
        return torch.lerp(weights, weights.index_select(1, self._mirror), share).reshape(*nodes.shape, -1)

    def _weights_of(self, rows: Tensor) -> Tensor:
        """Return the weights [K, J] at rows [K] of the logits."""
        chosen = self.logits.index_select(0, rows)  # whose gradient is faster than that of an index
        return self.softmax(self.sharpness * chosen)

    @torch.no_grad()
    def extend_from(self, nodes: Tensor) -> Tensor:
        """Make the weights of all but some nodes harmonic: each has the mean of its neighbours, which adds no extremes.

        Elsewhere than around the surface no sample determines the weights, and what training left there can tear parts off the
        body in unseen poses.

        Args:
            nodes: [D, H, W], bool, the nodes that keep their weights, at least one; their images too if there is a symmetry.

        Returns:
            Which rows of the logits have changed, bool.
        """
        if self.is_symmetric:
            nodes = nodes | nodes.flip(2)
        size = CanonicalGrid(self.lower, self.upper, checked=True).cell_size(self.shape)
        logits = self._logits_of(harmonic(self.at_nodes().reshape(*self.shape, -1), nodes, size, _SOLVED), _LEAST_WEIGHT)
        kept = self.optimised(nodes).reshape(-1)
        self.logits.copy_(torch.where(kept[:, None], self.logits, logits))
        return ~kept

    @torch.no_grad()
    def set_weights(self, weights: Tensor, least: float = _LEAST_WEIGHT) -> None:
        """Start from given weights.

        Args:
            weights: [D, H, W, J], at the nodes, non-negative, rows sum to 1; symmetric if the field is.
            least: smaller weights become this one, since a weight of zero has no gradient.
        """
        self.logits.copy_(self._logits_of(weights, least))

    def _logits_of(self, weights: Tensor, least: float) -> Tensor:
        """Return the logits at the optimised nodes for weights [D, H, W, J] at all nodes."""
        logs = self.optimised(weights).clamp_min(least).log()
        return self.softmax.invert(logs.reshape(-1, logs.shape[-1])) / self.sharpness
