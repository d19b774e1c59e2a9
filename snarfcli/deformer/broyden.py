"""The papers' correspondence search: Broyden's method from several starts (SNARF Sec. 3.2, Fast-SNARF Alg. 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate
from snarfcli.deformer.roots import Roots, drop_duplicates, invert_3x3
from snarfcli.deformer.trilinear import forward_jacobian

__all__ = ["broyden_roots"]

_QUERIES_AT_ONCE = 16_384
_SAME_ROOT = 5e-2  # of a cell; Broyden's roots are only as exact as the tolerance


def broyden_roots(
    points: Tensor,
    transforms: Tensor,
    starts: Tensor,
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    *,
    exact_jacobian: bool = True,
    tolerance: float,
    divergence: float,
    max_steps: int,
) -> Roots:
    """Find canonical correspondences from the start points B_i^-1 x', or from given ones.

    Differs from the released code in three places: the start Jacobian is exact, a step outside the grid is clamped to its
    border (in that code the transforms outside are zero), and J^-1 at the root is exact if `exact_jacobian`.

    Args:
        points: [B, N, 3], queries, posed space, metres. Non-finite ones have no root.
        transforms: [B, D * H * W, 12], blended transforms at the nodes.
        starts: [B, I, 12], upper three rows of the inverse transforms of the start bones, or [B, N, I, 3], canonical points,
            metres, of which one that is not finite is no start.
        grid: the box of the nodes.
        shape: nodes (D, H, W).
        exact_jacobian: the inverse Jacobian at the root, or the approximation left by the iteration (Fast-SNARF Eq. 15).
        tolerance: largest residual of a root, metres.
        divergence: residual after a step at which a start is given up, metres.
        max_steps: maximum number of steps from one start.

    Source: SNARF Eq. 6-8; Fast-SNARF Eq. 7-9 and Sec. 4.1.
    """
    batch, count = points.shape[:2]
    same = _SAME_ROOT * float(grid.cell_size(shape).min())
    parts = []
    for b in range(batch):
        for first in range(0, max(count, 1), _QUERIES_AT_ONCE):
            queries = points[b, first : first + _QUERIES_AT_ONCE]
            given = starts[b] if starts.ndim == 3 else starts[b, first : first + _QUERIES_AT_ONCE]
            roots = _iterate(
                queries, *_starts(queries, given), transforms[b], grid, shape, exact_jacobian, tolerance, divergence, max_steps
            )
            roots.query += b * count + first
            parts.append(drop_duplicates(roots, same))
    if not parts:
        none = torch.empty(0, dtype=torch.long, device=points.device)
        empty = transforms.new_empty(1, 12)
        return _iterate(points.reshape(-1, 3), none, points.new_empty(0, 3), empty, grid, shape, True, 0.0, 0.0, 0)
    return Roots.concatenate(parts)


def _starts(queries: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the queries [S], as indices, and the canonical points [S, 3] of all starts.

    Args:
        queries: [N, 3].
        starts: [I, 12] or [N, I, 3], see `broyden_roots`.
    """
    if starts.ndim == 2:
        rows = starts.reshape(-1, 3, 4)
        starts = torch.einsum("irc,nc->nir", rows[..., :3], queries) + rows[..., 3]
    query, number = (queries.isfinite().all(1)[:, None] & starts.isfinite().all(2)).nonzero(as_tuple=True)
    return query, starts[query, number]


def _iterate(
    points: Tensor,
    query: Tensor,
    canonical: Tensor,
    transforms: Tensor,
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    exact_jacobian: bool,
    tolerance: float,
    divergence: float,
    max_steps: int,
) -> Roots:
    """Run Broyden's method for each pair of query [S] and start [S, 3]; keep what converges inside the grid."""
    size = grid.cell_size(shape)

    def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
        cell, local = locate(x, grid, shape)
        corners = transforms.index_select(0, cell_corners(cell, shape).reshape(-1)).reshape(-1, 8, 12)
        posed, by_local = forward_jacobian(corners, local, x - local * size, size)
        return posed, by_local / size

    x = canonical.clamp(grid.lower, grid.upper)
    found = []
    posed, first_jacobian = evaluate(x) if len(x) else (x, x.new_empty(0, 3, 3))
    residual = posed - points[query]
    inverse = invert_3x3(first_jacobian)[0].nan_to_num(0, 0, 0)
    for step_number in range(max_steps + 1):
        distance = residual.norm(dim=1)
        converged = distance < tolerance
        done = converged.nonzero()[:, 0]
        found.append((x[done], query[done], inverse[done]))
        limit = divergence if step_number else torch.inf  # as SNARF does, the start itself is not judged
        going = (~converged & (distance < limit)).nonzero()[:, 0]
        if step_number == max_steps or not len(going):
            break
        query, x, residual, inverse = query[going], x[going], residual[going], inverse[going]
        moved = (x - torch.bmm(inverse, residual[:, :, None])[:, :, 0]).clamp(grid.lower, grid.upper)
        step, x = moved - x, moved
        posed, _ = evaluate(x)
        change = posed - points[query] - residual
        residual = residual + change
        # Rank-one update of the inverse (Broyden 1965, "good" method by Sherman and Morrison).
        towards = torch.bmm(inverse, change[:, :, None])
        row = torch.bmm(step[:, None], inverse)
        scale = torch.bmm(step[:, None], towards)
        update = (step[:, :, None] - towards) @ row / scale
        inverse = inverse + torch.where(scale.abs() > 1e-20, update, 0.0)
    x, query, inverse = (torch.cat(parts) for parts in zip(*found, strict=True))
    if exact_jacobian and len(x):
        inverse = invert_3x3(evaluate(x)[1])[0]
    roots = Roots(x, query, inverse)
    # Where the Jacobian is singular there is no inverse to report.
    return roots.take(inverse.isfinite().flatten(1).all(1).nonzero()[:, 0])
