"""Complete correspondence search: every root of d(x) = x' in the grid, cell by cell.

Inside one cell T(x) is a convex combination of the eight corner transforms T_k, so d(cell) lies inside the box spanned by
T_k [x; 1] over the corners k and the x of the cell. The queries inside that box are the only ones that can have a root in the
cell, and Newton's method with the exact Jacobian of the trilinear field finds it from the cell's centre. No start bones,
nothing to tune, and a query outside all boxes is known to have no correspondence at all.

This is the readable version in PyTorch. A cell in which the determinant of the Jacobian changes sign may hold several roots
for one query; one start finds one of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid, cell_corners
from snarfcli.deformer.search import Roots, drop_duplicates, invert_3x3
from snarfcli.deformer.skinning import forward_jacobian

__all__ = ["complete_roots", "posed_cell_boxes"]

_QUERIES_AT_ONCE = 65_536  # bounds the memory: about 20 candidate cells of 450 bytes for a query near the body
_BINS_PER_SIDE = 96
_STRAY = 1.25  # cells from the centre at which a candidate is given up; a neighbour then owns the root, if there is one
_FACE_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}  # of a cell; rounding may put a root on a face outside both
_POLISH = 1e-2  # of a cell; so short a step leaves the Jacobian as it is
_SAME_ROOT = 5e-3  # of a cell; Newton's last step leaves errors a hundred times smaller


def complete_roots(
    points: Tensor,
    transforms: Tensor,
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    *,
    active_cells: Tensor | None = None,
    tolerance: float,
    max_steps: int,
) -> Roots:
    """Find the canonical correspondences of posed points in every active grid cell.

    Args:
        points: queries [B, N, 3], posed space, metres. Non-finite ones have no root.
        transforms: blended transforms [B, D * H * W, 12] at the nodes (see `blend_transforms`).
        grid: where the nodes are.
        shape: (D, H, W).
        active_cells: bool [(D-1) * (H-1) * (W-1)], cells to search; None for all.
        tolerance: largest residual of a root, metres.
        max_steps: most Newton steps in one cell.

    Returns:
        The roots of all queries, without duplicates.
    """
    batch, count = points.shape[:2]
    total_cells = (shape[0] - 1) * (shape[1] - 1) * (shape[2] - 1)
    if active_cells is None:
        cells = torch.arange(total_cells, device=points.device)
    else:
        cells = active_cells.reshape(-1).nonzero()[:, 0]
    corners = cell_corners(cells, shape)
    origins = grid.nodes(shape).reshape(-1, 3)[corners[:, 0]]
    size = grid.cell_size(shape)
    parts = []
    for b in range(batch):
        corner_transforms = transforms[b][corners]
        lower, upper = posed_cell_boxes(corner_transforms, origins, size)
        for start in range(0, max(count, 1), _QUERIES_AT_ONCE):
            queries = points[b, start : start + _QUERIES_AT_ONCE]
            query, candidate = _candidates(queries, lower, upper)
            roots = _newton(queries, query, candidate, corner_transforms, origins, size, tolerance, max_steps)
            roots.query += b * count + start
            roots.cell = cells[roots.cell]
            parts.append(drop_duplicates(roots, _SAME_ROOT * float(size.min())))
    if not parts:
        return _newton(points.reshape(-1, 3), cells[:0], cells[:0], transforms.new_empty(0, 8, 12), origins, size, 0.0, 0)
    return Roots.concatenate(parts)


def posed_cell_boxes(corner_transforms: Tensor, origins: Tensor, cell_size: Tensor) -> tuple[Tensor, Tensor]:
    """Return posed-space boxes (lower [C, 3], upper [C, 3]) that contain the image of each cell, metres.

    Args:
        corner_transforms: blended transforms at the corners of the cells, [C, 8, 12].
        origins: canonical position of each cell's first corner, [C, 3], metres.
        cell_size: [3], metres.
    """
    rows = corner_transforms.reshape(-1, 8, 3, 4)
    start = (rows[..., :3] * origins[:, None, None]).sum(-1) + rows[..., 3]
    reach = rows[..., :3] * cell_size
    return (start + reach.clamp(max=0).sum(-1)).amin(1), (start + reach.clamp(min=0).sum(-1)).amax(1)


def _candidates(points: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Return all pairs (query [P], cell [P]) where the query lies in the cell's posed box, cell by cell.

    The queries are sorted into uniform bins, x fastest, so that a run of bins along x is one contiguous range of queries.
    """
    device = points.device
    known = points.isfinite().all(1).nonzero()[:, 0]
    boxed = (lower.isfinite() & upper.isfinite()).all(1)
    if not len(known) or not bool(boxed.any()):
        nothing = torch.empty(0, dtype=torch.long, device=device)
        return nothing, nothing
    finite = points[known]
    # Queries beyond every box need no bin of their own.
    near = ((finite >= lower[boxed].amin(0)) & (finite <= upper[boxed].amax(0))).all(1)
    known, finite = known[near], finite[near]
    if not len(known):
        return known, known
    first, last = finite.amin(0), finite.amax(0)
    side = max(float((last - first).max()) / _BINS_PER_SIDE, float((upper - lower)[boxed].mean()), 1e-9)
    bins = ((last - first) / side).long() + 1
    index = ((finite - first) / side).long().minimum(bins - 1)
    key = (index[:, 2] * bins[1] + index[:, 1]) * bins[0] + index[:, 0]
    order = torch.argsort(key, stable=True)
    sorted_points, known = finite[order], known[order]
    begin = torch.zeros(int(bins.prod()) + 1, dtype=torch.long, device=device)
    begin[1:] = torch.bincount(key, minlength=int(bins.prod())).cumsum(0)

    touched = (boxed & (upper >= first).all(1) & (lower <= last).all(1)).nonzero()[:, 0]
    low = ((lower[touched] - first) / side).clamp_min(0).long()
    high = ((upper[touched] - first) / side).clamp_min(0).long().minimum(bins - 1)
    low = low.minimum(bins - 1)
    rows = high[:, 1:] - low[:, 1:] + 1
    owner, nth = _expand(rows.prod(1))
    y = low[owner, 1] + nth % rows[owner, 0]
    z = low[owner, 2] + nth // rows[owner, 0]
    row = (z * bins[1] + y) * bins[0]
    row_begin, row_end = begin[row + low[owner, 0]], begin[row + high[owner, 0] + 1]
    range_owner, nth = _expand(row_end - row_begin)
    at = row_begin[range_owner] + nth
    cell = touched[owner[range_owner]]
    query_points = sorted_points[at]
    inside = ((query_points >= lower[cell]) & (query_points <= upper[cell])).all(1).nonzero()[:, 0]
    return known[at[inside]], cell[inside]


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return, for every one of counts.sum() items, its owner's index and its number within the owner."""
    owner = torch.repeat_interleave(counts)
    return owner, torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts)[owner]


def _newton(
    points: Tensor,
    query: Tensor,
    cell: Tensor,
    corner_transforms: Tensor,
    origins: Tensor,
    cell_size: Tensor,
    tolerance: float,
    max_steps: int,
) -> Roots:
    """Run Newton's method for each pair of query and cell (SNARF Eq. 6 with the exact Jacobian); keep roots in the cell."""
    reach = 0.5 + _FACE_TOLERANCE[points.dtype]
    local = points.new_full((len(query), 3), 0.5)
    found = [(query[:0], cell[:0], local[:0], points.new_empty(0, 3, 3))]
    for _ in range(max_steps):
        if not len(query):
            break
        posed, jacobian = forward_jacobian(corner_transforms[cell], local, origins[cell], cell_size)
        residual = posed - points[query]
        inverse, _ = invert_3x3(jacobian)
        step = torch.bmm(inverse, residual[:, :, None])[:, :, 0]
        longest = step.abs().amax(1, keepdim=True)
        converged = residual.norm(dim=1) < tolerance
        # A last, tiny step polishes a converged root; beside a fold, where it is not tiny, the point stays where it is.
        trusted = (~converged)[:, None] | (longest < _POLISH)
        local = torch.where(trusted, local - step / longest.clamp_min(1), local)
        in_cell = ((local - 0.5).abs() <= reach).all(1)
        done = (converged & in_cell).nonzero()[:, 0]
        found.append((query[done], cell[done], local[done], inverse[done] * cell_size[:, None]))
        going = (~converged & ((local - 0.5).abs() < _STRAY).all(1)).nonzero()[:, 0]
        query, cell, local = query[going], cell[going], local[going]
    query, cell, local, inverse = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Roots(origins[cell] + local * cell_size, query, inverse, cell, local)
