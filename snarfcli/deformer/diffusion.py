"""Given skinning weights: extended from the vertices of a mesh to the whole canonical grid."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.deformer.harmonic import harmonic
from snarfcli.deformer.skinning import interpolate
from snarfcli.deformer.weights import GridWeights

__all__ = ["PresetWeights", "diffuse_weights"]

_NEIGHBOURS = 8  # vertices that determine the weights of a node near the surface
_NODES_AT_ONCE = 4096  # bounds the memory of the distances to all vertices
_ROUNDS = 3  # mean error at the vertices of the built-in body, 64 x 64 x 16: none 3.0 %, 3 rounds 2.0 %, 100 rounds 1.7 %
_SMALL = 10_000  # number of nodes of a grid on which the solver converges fast enough
_SOLVED = 1e-4  # largest change of a weight by one more step of the solver
_SUM_TOLERANCE = 1e-3  # files often hold weights in single precision, cut to a few bones


class PresetWeights(GridWeights):
    """Weights at the grid nodes that are given and not trained.

    Args:
        grid: its box.
        weights: [D, H, W, J], at the nodes.
    """

    weights: Tensor

    def __init__(self, grid: CanonicalGrid, weights: Tensor) -> None:
        depth, height, width = weights.shape[:3]
        super().__init__(grid, (depth, height, width))
        self.register_buffer("weights", weights.detach().reshape(-1, weights.shape[-1]).clone())

    @classmethod
    def from_vertices(
        cls, vertices: Tensor, weights: Tensor, grid: CanonicalGrid, shape: tuple[int, int, int]
    ) -> PresetWeights:
        """Diffuse the weights of a mesh into the grid (see `diffuse_weights` for the arguments and errors)."""
        return cls(grid, diffuse_weights(vertices, weights, grid, shape))

    @classmethod
    def placeholder(cls, grid: CanonicalGrid, shape: tuple[int, int, int], num_bones: int) -> PresetWeights:
        """Return equal weights everywhere, for `load_state_dict` to replace."""
        return cls(grid, torch.full((*shape, num_bones), 1 / num_bones).to(grid.lower))

    def at_nodes(self, nodes: Tensor | None = None) -> Tensor:
        """Return the weights [..., J] at the nodes with flat indices [...], or of all nodes, [D * H * W, J]."""
        return self.weights if nodes is None else self.weights[nodes]


def diffuse_weights(vertices: Tensor, weights: Tensor, grid: CanonicalGrid, shape: tuple[int, int, int]) -> Tensor:
    """Extend the skinning weights of a mesh to all grid nodes.

    The corners of every cell that holds a vertex take the weights of the nearest vertices, corrected so that the trilinear
    field meets the weights at the vertices as far as the cells allow. Between and beyond them the weights are harmonic, as
    heat is at rest: each free node has the mean of its neighbours (weighted by 1 / distance^2, with nothing flowing through
    the border of the box). Such a mean is never negative, sums to 1, and adds no extremes.

    Args:
        vertices: [V, 3], canonical frame, metres; inside the grid's box.
        weights: [V, J], non-negative, rows sum to 1.
        grid: the box of the nodes.
        shape: nodes (D, H, W).

    Returns:
        [D, H, W, J], non-negative, rows sum to 1, with the dtype and device of `grid`.

    Raises:
        ValueError: a shape does not fit, a number is not finite, a weight is negative, a row does not sum to 1 (within 1e-3),
            or a vertex lies outside the box.
    """
    _check(vertices, weights, grid)
    points, given = vertices.detach().to(grid.lower), weights.detach().to(grid.lower)
    return _diffuse(points, given / given.sum(1, keepdim=True), grid, shape)


def _diffuse(points: Tensor, weights: Tensor, grid: CanonicalGrid, shape: tuple[int, int, int]) -> Tensor:
    """Solve `diffuse_weights`, first on a grid of half the resolution, since diffusion is slow over many cells."""
    nodes = grid.nodes(shape).reshape(-1, 3)
    if len(nodes) > _SMALL and min(shape) > 2:
        half = (shape[0] // 2 + 1, shape[1] // 2 + 1, shape[2] // 2 + 1)
        coarse = _diffuse(points, weights, grid, half)
        values = torch.cat([interpolate(coarse, some, grid) for some in nodes.split(_NODES_AT_ONCE)])
    else:
        values = weights.mean(0).expand(len(nodes), -1).clone()
    cell, local = locate(points, grid, shape)
    corners = cell_corners(cell, shape)
    fixed, corner = corners.unique(return_inverse=True)
    near = _near_surface(nodes[fixed], points, weights)
    values[fixed] = _corrected(near, corner, trilinear_weights(local.clamp(0, 1)), weights)
    is_fixed = torch.zeros(len(nodes), dtype=torch.bool, device=nodes.device)
    is_fixed[fixed] = True
    values = harmonic(values.reshape(*shape, -1), is_fixed.reshape(shape), grid.cell_size(shape), _SOLVED).clamp_min(0)
    return values / values.sum(-1, keepdim=True)


def _near_surface(nodes: Tensor, vertices: Tensor, weights: Tensor) -> Tensor:
    """Return weights [K, J] at nodes [K, 3] from their nearest vertices; nearer vertices weigh more.

    The share of a vertex falls with its distance beyond that of the nearest one, relative to the distances between the
    neighbours; so a node between two vertices gets a mean, and one on a vertex almost the weights of that vertex.
    """
    count = min(_NEIGHBOURS, len(vertices))
    parts = []
    for some in nodes.split(_NODES_AT_ONCE):
        squared, index = (
            torch.cdist(some, vertices, compute_mode="donot_use_mm_for_euclid_dist").square().topk(count, dim=1, largest=False)
        )
        beyond = squared - squared[:, :1]
        scale = beyond[:, min(3, count - 1), None].clamp_min(1e-12)
        share = torch.exp(-2 * beyond / scale)
        share = share / share.sum(1, keepdim=True)
        parts.append((share[..., None] * weights[index]).sum(1))
    return torch.cat(parts)


def _corrected(values: Tensor, corner: Tensor, phi: Tensor, weights: Tensor) -> Tensor:
    """Correct node values [K, J] so that they interpolate to the given weights [V, J] at the vertices more exactly.

    Each round spreads the error of a vertex over the corners of its cell, by their trilinear weights. Since all rows sum to 1,
    an error sums to 0. More rounds follow the vertices more closely but are wrong beside them.

    Args:
        values: [K, J], rows sum to 1.
        corner: [V, 8], numbers of the nodes at the corners of each vertex's cell, 0 to K - 1.
        phi: [V, 8], their trilinear weights.
        weights: [V, J], rows sum to 1.
    """
    mass = values.new_zeros(len(values)).index_add(0, corner.reshape(-1), phi.reshape(-1)).clamp_min(1e-6)[:, None]
    for _ in range(_ROUNDS):
        lacking = weights - (phi[..., None] * values[corner]).sum(1)
        spread = (phi[..., None] * lacking[:, None]).reshape(-1, values.shape[1])
        values = (values + torch.zeros_like(values).index_add(0, corner.reshape(-1), spread) / mass).clamp_min(0)
        values = values / values.sum(1, keepdim=True)
    return values


def _check(vertices: Tensor, weights: Tensor, grid: CanonicalGrid) -> None:
    """Raise ValueError for vertices and weights that cannot be used."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise ValueError(f"vertices: wanted shape [V, 3], at least one, got {list(vertices.shape)}")
    if weights.ndim != 2 or len(weights) != len(vertices) or not weights.shape[1]:
        raise ValueError(f"weights: wanted shape [{len(vertices)}, J], one row per vertex, got {list(weights.shape)}")
    for name, tensor in (("vertices", vertices), ("weights", weights)):
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"{name}: wanted finite numbers, got NaN or infinite ones")
    if bool((weights < 0).any()):
        raise ValueError(f"weights: wanted 0 or more, got {float(weights.min()):g}")
    sums = weights.double().sum(1)
    if bool(((sums - 1).abs() > _SUM_TOLERANCE).any()):
        raise ValueError(f"weights: wanted a sum of 1 per vertex, got sums from {float(sums.min()):g} to {float(sums.max()):g}")
    points = vertices.to(grid.lower)
    outside = int(((points < grid.lower) | (points > grid.upper)).any(1).sum())
    if outside:
        raise ValueError(
            f"vertices: wanted all in the canonical box from {_text(grid.lower)} to {_text(grid.upper)} metres, "
            f"got {outside} of {len(vertices)} outside, in a box from {_text(points.amin(0))} to {_text(points.amax(0))}"
        )


def _text(corner: Tensor) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in corner.tolist()) + ")"
