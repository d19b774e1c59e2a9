"""Given skinning weights: extended from the vertices of a mesh to the whole canonical grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.deformer.harmonic import harmonic
from snarfcli.deformer.weights import GridWeights
from snarfcli.progress import progress_bar

__all__ = ["PresetWeights", "diffuse_weights"]

_NEIGHBOURS = 8  # vertices that determine the weights of a node near the surface
_BLOCK = 8  # side of the cubes of nodes that look for vertices together
_ROUNDING = 1 + 1e-5  # more than rounding adds to a distance
_ROUNDS = 3  # mean error at the vertices of the built-in body, 64 x 64 x 16: none 3.0 %, 3 rounds 2.0 %, 100 rounds 1.7 %
_SOLVED = 3e-4  # largest change of a weight by one more step of the solver, and about the largest error
_LONG = 5_000_000  # number of values from which there is a bar
_SUM_TOLERANCE = 1e-3  # files often hold weights in single precision, cut to a few bones


class PresetWeights(GridWeights):
    """Weights at the grid nodes that are given and not trained.

    Args:
        grid: its box.
        weights: [D, H, W, J], at the nodes.
    """

    weights: Tensor

    def __init__(self, grid: CanonicalGrid, weights: Tensor) -> None:
        if weights.ndim != 4:
            raise ValueError(f"weights: wanted shape [D, H, W, J], got {list(weights.shape)}")
        depth, height, width = weights.shape[:3]
        super().__init__(grid, (depth, height, width))
        self.register_buffer("weights", weights.detach().reshape(-1, weights.shape[-1]).clone())

    @classmethod
    def from_vertices(
        cls,
        vertices: Tensor,
        weights: Tensor,
        grid: CanonicalGrid,
        shape: tuple[int, int, int],
        progress: Callable[[float], object] | None = None,
    ) -> PresetWeights:
        """Diffuse the weights of a mesh into the grid (see `diffuse_weights` for the arguments and errors)."""
        return cls(grid, diffuse_weights(vertices, weights, grid, shape, progress))

    @classmethod
    def placeholder(cls, grid: CanonicalGrid, shape: tuple[int, int, int], num_bones: int) -> PresetWeights:
        """Return equal weights everywhere, for `load_state_dict` to replace."""
        return cls(grid, torch.full((*shape, num_bones), 1 / num_bones).to(grid.lower))

    def at_nodes(self, nodes: Tensor | None = None) -> Tensor:
        """Return the weights [..., J] at the nodes with flat indices [...], or of all nodes, [D * H * W, J]."""
        return self.weights if nodes is None else self.weights[nodes]


def diffuse_weights(
    vertices: Tensor,
    weights: Tensor,
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    progress: Callable[[float], object] | None = None,
) -> Tensor:
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
        progress: called from time to time with the share of the work that is done, up to 1. None shows a bar on a terminal if
            it takes seconds (128 x 128 x 32 nodes and 24 bones: three).

    Returns:
        [D, H, W, J], non-negative, rows sum to 1, with the dtype and device of `grid`.

    Raises:
        ValueError: a shape does not fit, a number is not finite, a weight is negative, a row does not sum to 1 (within 1e-3),
            or a vertex lies outside the box.
    """
    _check(vertices, weights, grid)
    vertices, weights = vertices.detach().to(grid.lower), weights.detach().to(grid.lower)
    weights = weights / weights.sum(1, keepdim=True)
    cell, local = locate(vertices, grid, shape)
    fixed, corner = cell_corners(cell, shape).unique(return_inverse=True)
    near = _near_surface(fixed, vertices, weights, grid, shape)
    values = weights.mean(0).repeat(math.prod(shape), 1)
    values[fixed] = _corrected(near, corner, trilinear_weights(local.clamp(0, 1)), weights)
    is_fixed = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    is_fixed[fixed] = True
    with _reporting(values.numel(), weights.shape[1], progress) as report:
        values = harmonic(
            values.reshape(*shape, -1), is_fixed.reshape(shape), grid.cell_size(shape), _SOLVED, report
        ).clamp_min(0)
    return values / values.sum(-1, keepdim=True)


@contextmanager
def _reporting(values: int, bones: int, progress: Callable[[float], object] | None) -> Iterator[Callable[[int], object] | None]:
    """Yield a function that is told how many bones were solved in addition; see `diffuse_weights`."""
    done = 0

    def tell(more: int) -> None:
        nonlocal done
        done += more
        if progress is not None:
            progress(done / bones)

    if progress is not None or values < _LONG:
        yield tell
        return
    with progress_bar(total=bones, desc="diffuse weights", unit="bone") as bar:
        yield None if bar is None else bar.update


def _near_surface(fixed: Tensor, vertices: Tensor, weights: Tensor, grid: CanonicalGrid, shape: tuple[int, int, int]) -> Tensor:
    """Return weights [K, J] at nodes with flat indices [K] from their nearest vertices; nearer vertices weigh more.

    The share of a vertex falls with its distance beyond that of the nearest one, relative to the distances between the
    neighbours; so a node between two vertices gets a mean, and one on a vertex almost the weights of that vertex.
    """
    nodes = grid.nodes(shape).reshape(-1, 3)[fixed]
    values = weights.new_empty(len(fixed), weights.shape[1])
    for some in _blocks(fixed, shape):
        squared, index = _nearest(nodes[some], vertices)
        beyond = squared - squared[:, :1]
        scale = beyond[:, min(3, beyond.shape[1] - 1), None].clamp_min(1e-12)
        share = torch.exp(-2 * beyond / scale)
        share = share / share.sum(1, keepdim=True)
        values[some] = (share[..., None] * weights[index]).sum(1)
    return values


def _blocks(nodes: Tensor, shape: tuple[int, int, int]) -> Iterator[Tensor]:
    """Yield the positions in `nodes`, flat indices [K], of those in each cube of nodes."""
    x, y, z = nodes % shape[2], nodes // shape[2] % shape[1], nodes // (shape[2] * shape[1])
    block = ((z // _BLOCK * shape[1]) + y // _BLOCK) * shape[2] + x // _BLOCK
    block, order = block.sort(stable=True)
    yield from order.split(block.unique_consecutive(return_counts=True)[1].tolist())


def _nearest(nodes: Tensor, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Return the squared distances and the indices, [K, n] each, of the vertices nearest to nodes that lie close together."""
    count = min(_NEIGHBOURS, len(vertices))
    centre = (nodes.amin(0) + nodes.amax(0)) / 2
    distance, radius = (vertices - centre).norm(dim=1), (nodes - centre).norm(dim=1).max()
    # The vertices nearest to the centre are at most so far from every node; no vertex beyond can be nearer.
    reach = distance.topk(count, largest=False).values[-1] + 2 * radius
    near = (distance <= _ROUNDING * reach).nonzero()[:, 0]
    distances = torch.cdist(nodes, vertices[near], compute_mode="donot_use_mm_for_euclid_dist")
    squared, index = distances.square().topk(count, dim=1, largest=False)
    return squared, near[index]


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
