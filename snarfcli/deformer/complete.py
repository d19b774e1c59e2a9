"""Complete correspondence search: the roots of d(x) = x' in the grid, cell by cell.

Inside one cell T(x) is a convex combination of the eight corner transforms T_k, so d(cell) lies inside the box spanned by
T_k [x; 1] over the corners k and the x of the cell. Only queries inside that box can have a root in the cell. The first step of
Newton's method from the cell's centre needs only the value and the inverse Jacobian at the centre, which all queries of a cell
share. If it leads too far out of the cell, given how curved the field is in it, the pair is dropped. The remaining pairs, about
three per root while an avatar trains, are solved with the exact Jacobian of the trilinear field. There are no start bones, and
a query outside all boxes is known to have no correspondence.

This is the readable version in PyTorch, for tensors without a native kernel. Unlike the native kernels
(csrc/include/snarf/cell.h) it may miss two kinds of roots: a second root of a query in one cell, where the determinant of the
Jacobian changes sign and one start is not enough; and a root in a cell that is more curved between its corners than _CURVED and
_SLACK allow for.
"""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CORNERS, CanonicalGrid, cell_corners
from snarfcli.deformer.roots import Roots, drop_duplicates, invert_3x3
from snarfcli.deformer.skinning import forward_jacobian

__all__ = ["complete_roots", "posed_cell_boxes"]

_QUERIES_AT_ONCE = 65_536  # bounds the memory: a query has several candidate cells
_CELLS_AT_ONCE = 200_000  # bounds the memory: 400 bytes of corner transforms per cell, and as much per intermediate result
_BINS_PER_SIDE = 96
_STRAY = 0.75  # of a cell; a candidate this far outside its cell is dropped, a neighbour finds the root if there is one
_CURVED = 2.0  # bound of the field's deviation from linear inside a cell, in units of that at its corners
_SLACK = 0.1  # of a cell, beyond that
_FACE_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}  # of a cell; rounding may put a root on a face outside both
_POLISH = 1e-2  # of a cell; a step this short does not change the Jacobian noticeably
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
        points: [B, N, 3], queries, posed space, metres. Non-finite ones have no root.
        transforms: [B, D * H * W, 12], blended transforms at the nodes (see `blend_transforms`).
        grid: the box of the nodes.
        shape: nodes (D, H, W).
        active_cells: [D-1, H-1, W-1], bool, cells to search; None for all.
        tolerance: largest residual of a root, metres.
        max_steps: maximum number of Newton steps in one cell.

    Returns:
        The roots of all queries, without duplicates.
    """
    batch, count = points.shape[:2]
    if active_cells is None:
        cells = torch.arange((shape[0] - 1) * (shape[1] - 1) * (shape[2] - 1), device=points.device)
    else:
        cells = active_cells.reshape(-1).nonzero()[:, 0]
    corners = cell_corners(cells, shape)
    origins = grid.nodes(shape).reshape(-1, 3)[corners[:, 0]]
    size = grid.cell_size(shape)
    # Several poses are processed together, as far as memory allows.
    poses_at_once = max(1, min(_CELLS_AT_ONCE // max(len(cells), 1), _QUERIES_AT_ONCE // max(count, 1)))
    parts = []
    for first in range(0, batch, poses_at_once):
        some = transforms[first : first + poses_at_once]
        corner_transforms = some[:, corners].reshape(-1, 8, 12)
        places = origins.repeat(len(some), 1)
        boxes = posed_cell_boxes(corner_transforms, places, size)
        centres = _centres(corner_transforms, places, size)
        for start in range(0, max(count, 1), _QUERIES_AT_ONCE):
            queries = points[first : first + len(some), start : start + _QUERIES_AT_ONCE]
            flat = queries.reshape(-1, 3)
            query, cell = _candidates(queries, *boxes)
            query, cell, local = _first_step(flat, query, cell, *centres)
            roots = _newton(flat, query, cell, local, corner_transforms, places, size, tolerance, max_steps)
            width = max(queries.shape[1], 1)
            roots.query = (first + roots.query // width) * count + start + roots.query % width
            parts.append(drop_duplicates(roots, _SAME_ROOT * float(size.min())))
    if not parts:
        nothing = cells[:0], cells[:0], points.new_empty(0, 3)
        return _newton(points.reshape(-1, 3), *nothing, transforms.new_empty(0, 8, 12), origins, size, 0.0, 0)
    return Roots.concatenate(parts)


def posed_cell_boxes(corner_transforms: Tensor, origins: Tensor, cell_size: Tensor) -> tuple[Tensor, Tensor]:
    """Return posed-space boxes (lower [C, 3], upper [C, 3]) that contain the image of each cell, metres.

    Args:
        corner_transforms: [C, 8, 12], blended transforms at the corners of the cells.
        origins: [C, 3], canonical position of each cell's first corner, metres.
        cell_size: [3], metres.
    """
    start, sides = _images(corner_transforms, origins, cell_size)
    return (start + sides.clamp(max=0).sum(-1)).amin(1), (start + sides.clamp(min=0).sum(-1)).amax(1)


def _images(corner_transforms: Tensor, origins: Tensor, cell_size: Tensor) -> tuple[Tensor, Tensor]:
    """Return the images of the cell's first corner, [C, 8, 3], and of its sides, [C, 8, 3, 3], under each corner's transform.

    Column i of the sides is the image of the cell's side along axis i.
    """
    rows = corner_transforms.reshape(len(corner_transforms), 24, 4)
    homogeneous = torch.cat([origins, torch.ones_like(origins[:, :1])], 1)
    start = torch.bmm(rows, homogeneous[:, :, None]).reshape(-1, 8, 3)
    return start, rows.reshape(-1, 8, 3, 4)[..., :3] * cell_size


def _candidates(points: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Return all pairs (query [P], cell [P]) of the same pose where the query lies in the cell's posed box, cell by cell.

    The queries are sorted into uniform bins, x fastest, so that a run of bins along x is one contiguous range of queries.

    Args:
        points: [G, N, 3], queries of G poses; numbered g * N + n in the result.
        lower, upper: [G * C, 3], boxes of C cells in each pose; numbered g * C + c in the result.
    """
    poses, count = points.shape[:2]
    flat = points.reshape(-1, 3)
    boxed = (lower.isfinite() & upper.isfinite()).all(1)
    if not len(flat) or not bool(boxed.any()):
        nothing = torch.empty(0, dtype=torch.long, device=points.device)
        return nothing, nothing
    # Queries outside every box need no bin; comparisons with non-finite ones are false.
    known = ((flat >= lower[boxed].amin(0)) & (flat <= upper[boxed].amax(0))).all(1).nonzero()[:, 0]
    if not len(known):
        return known, known
    near = flat[known]
    first, last = near.amin(0), near.amax(0)
    side = max(float((last - first).max()) / _BINS_PER_SIDE, float((upper - lower)[boxed].mean()), 1e-9)
    bins = ((last - first) / side).long() + 1
    place = ((near - first) / side).long().minimum(bins - 1)
    pose = known // count
    key = ((pose * bins[2] + place[:, 2]) * bins[1] + place[:, 1]) * bins[0] + place[:, 0]
    order = torch.argsort(key, stable=True)
    near, known = near[order], known[order]
    begin = torch.zeros(poses * int(bins.prod()) + 1, dtype=torch.long, device=points.device)
    begin[1:] = torch.bincount(key, minlength=len(begin) - 1).cumsum(0)

    touched = (boxed & (upper >= first).all(1) & (lower <= last).all(1)).nonzero()[:, 0]
    low = ((lower[touched] - first) / side).clamp_min(0).long().minimum(bins - 1)
    high = ((upper[touched] - first) / side).clamp_min(0).long().minimum(bins - 1)
    rows = high[:, 1:] - low[:, 1:] + 1
    owner, nth = _expand(rows.prod(1))
    y = low[owner, 1] + nth % rows[owner, 0]
    z = low[owner, 2] + nth // rows[owner, 0]
    cells_per_pose = len(lower) // poses
    row = ((touched[owner] // cells_per_pose * bins[2] + z) * bins[1] + y) * bins[0]
    row_begin, row_end = begin[row + low[owner, 0]], begin[row + high[owner, 0] + 1]
    range_owner, nth = _expand(row_end - row_begin)
    at = row_begin[range_owner] + nth
    cell = touched[owner[range_owner]]
    candidates = near.index_select(0, at)
    above, below = candidates >= lower.index_select(0, cell), candidates <= upper.index_select(0, cell)
    inside = (above & below).all(1).nonzero()[:, 0]
    return known[at[inside]], cell[inside]


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return, for each of counts.sum() items, the index of its owner and its number within the owner."""
    owner = torch.repeat_interleave(counts)
    return owner, torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts)[owner]


def _centres(corner_transforms: Tensor, origins: Tensor, cell_size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the values at cell centres that the first Newton step needs.

    Returns:
        Posed centres [C, 3], metres; inverse Jacobians [C, 3, 3] there, to cell coordinates; and the largest length of that
        step, in cell coordinates, at which the cell can still hold a root, [C].
    """
    middle = torch.full_like(origins, 0.5)
    posed, jacobian = forward_jacobian(corner_transforms, middle, origins, cell_size)
    inverse, _ = invert_3x3(jacobian)
    start, sides = _images(corner_transforms, origins, cell_size)
    offsets = CORNERS.to(cell_size)
    posed_corners = start + (sides * offsets[:, None]).sum(-1)
    linear = torch.bmm(posed_corners - posed[:, None], inverse.transpose(1, 2)) + 0.5
    deviation = (linear - offsets).abs().amax((1, 2))
    reach = 0.5 + _CURVED * deviation + _SLACK
    return posed, inverse, torch.where(reach.isfinite(), reach, torch.inf)


def _first_step(
    points: Tensor, query: Tensor, cell: Tensor, centres: Tensor, inverse: Tensor, reach: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Take Newton's step from the centre for each pair; return the pairs that may be roots and their positions, [P, 3]."""
    offset = points.index_select(0, query) - centres.index_select(0, cell)
    step = torch.bmm(inverse.index_select(0, cell), offset[:, :, None])[:, :, 0].nan_to_num(0, 0, 0)
    possible = (step.abs().amax(1) <= reach[cell]).nonzero()[:, 0]
    return query[possible], cell[possible], 0.5 + step[possible].clamp(-0.75, 0.75)


def _newton(
    points: Tensor,
    query: Tensor,
    cell: Tensor,
    local: Tensor,
    corner_transforms: Tensor,
    origins: Tensor,
    cell_size: Tensor,
    tolerance: float,
    max_steps: int,
) -> Roots:
    """Run Newton's method from `local` for each pair of query and cell; keep roots in the cell.

    Source: SNARF Eq. 6, with the exact Jacobian.
    """
    reach = 0.5 + _FACE_TOLERANCE[points.dtype]
    found = [(query[:0], cell[:0], local[:0], points.new_empty(0, 3, 3))]
    for _ in range(max_steps):
        if not len(query):
            break
        corners = corner_transforms.index_select(0, cell)
        posed, jacobian = forward_jacobian(corners, local, origins.index_select(0, cell), cell_size)
        residual = posed - points.index_select(0, query)
        inverse, _ = invert_3x3(jacobian)
        step = torch.bmm(inverse, residual[:, :, None])[:, :, 0]
        longest = step.abs().amax(1, keepdim=True)
        # Where the Jacobian is singular there is no inverse to report.
        converged = (residual.norm(dim=1) < tolerance) & longest[:, 0].isfinite()
        # A last, tiny step polishes a converged root; beside a fold, where it is not tiny, the point stays where it is.
        trusted = (~converged)[:, None] | (longest < _POLISH)
        local = torch.where(trusted, local - step / longest.clamp_min(1), local)
        from_centre = (local - 0.5).abs().amax(1)
        done = (converged & (from_centre <= reach)).nonzero()[:, 0]
        found.append((query[done], cell[done], local[done], inverse[done] * cell_size[:, None]))
        # Steps grow shorter towards a root: one that ends farther outside the cell than its length will not return.
        going = (~converged & (from_centre - 0.5 < longest[:, 0].clamp_max(_STRAY))).nonzero()[:, 0]
        query, cell, local = (pairs.index_select(0, going) for pairs in (query, cell, local))
    query, cell, local, inverse = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Roots(origins[cell] + local * cell_size, query, inverse)
