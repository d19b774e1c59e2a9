"""Complete correspondence search: every root of d(x) = x' in the grid, cell by cell, without start bones.

Only a query inside the box around a cell's posed image can have a root in the cell; a query outside all boxes is known to have
no correspondence. Newton's first step from the cell's centre needs only the inverse Jacobian there, which all queries of the
cell share. If it leads farther from the centre than the cell's curvature can explain, the pair of query and cell is dropped. In
a cell of little curvature a query has at most one root, and one start finds it. Other cells (next to a fold, where det J
changes sign, they always are) are cut into eight, again and again, and what is left gets several starts.

This is the readable version in PyTorch, for tensors without a native kernel. The native kernels (csrc/include/snarf/cell.h,
csrc/cpu/kernels.cpp) find the same roots.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.deformer.candidates import pairs_in_boxes
from snarfcli.deformer.cell_polynomials import (
    FACE_TOLERANCE,
    bound_boxes,
    bound_roots,
    cell_polynomials,
    cut_cells,
    evaluate,
    inverse_of,
    pick,
)
from snarfcli.deformer.grid import CORNERS, CanonicalGrid, cell_corners
from snarfcli.deformer.posed_boxes import polynomial_boxes
from snarfcli.deformer.roots import Roots, drop_duplicates

__all__ = ["complete_roots"]

_QUERIES_AT_ONCE = 65_536  # bounds the memory: a query has several candidate cells
_CELLS_AT_ONCE = 65_536  # bounds the memory: 400 bytes of corner transforms per cell, and as much per intermediate result
_PAIRS_AT_ONCE = 8192  # of a query and a cell, 400 bytes each: stays in a processor's cache, and bounds the memory for parts
_TAME = 0.9  # largest curvature of a cell that is solved from one start, as in csrc/include/snarf/search.h
_LEVELS = 4  # how often other cells are cut
_STRAY = 0.75  # of a cell; a start that leads this far out of its cell is given up, a neighbour finds the root if there is one
_LAST_STEP = {torch.float32: 2e-4, torch.float64: 1e-7}  # of a cell; so short a step leaves the root and its Jacobian exact
_TRUSTED = 1e-2  # of a cell; beside a fold, where no step is short, the longest that a point with a small residual still takes
_SAME_ROOT = 5e-3  # of a cell; Newton's last step leaves errors a hundred times smaller


@dataclass
class _Cells:
    """Grid cells in one or several poses, or equal parts of them."""

    polynomials: Tensor
    """[3, 3, 3, 3, C], see `cell_polynomials`."""
    centres: Tensor
    """[3, C], canonical, metres."""
    numbers: Tensor
    """[C], flat index of the grid cell."""
    size: Tensor
    """[3], metres."""
    level: int = 0
    """How often the grid cells were cut."""

    def take(self, index: Tensor) -> _Cells:
        """Return the cells at `index` [K]."""
        polynomials, centres = pick(self.polynomials, index), pick(self.centres, index)
        return _Cells(polynomials, centres, pick(self.numbers, index), self.size, self.level)

    def cut(self) -> _Cells:
        """Return the eighths of all cells, eighth k of cell c at k * C + c."""
        half = self.size / 2
        shifts = (CORNERS.to(half) - 0.5) * half
        centres = (self.centres[:, None] + shifts.T[..., None]).flatten(1)
        return _Cells(cut_cells(self.polynomials).flatten(4), centres, self.numbers.repeat(8), half, self.level + 1)


@dataclass
class _Pairs:
    """Pairs of a query and a cell."""

    query: Tensor
    """[P], index of the query."""
    cell: Tensor
    """[P], index of the cell."""
    start: Tensor
    """[3, P], where to look for the root first, cell coordinates."""

    def take(self, index: Tensor) -> _Pairs:
        """Return the pairs at `index` [K]."""
        return _Pairs(pick(self.query, index), pick(self.cell, index), pick(self.start, index))

    def split(self) -> Iterator[_Pairs]:
        """Yield the pairs, few at once."""
        parts = (values.split(_PAIRS_AT_ONCE, -1) for values in (self.query, self.cell, self.start))
        return (_Pairs(*some) for some in zip(*parts, strict=True))


@dataclass
class _Solver:
    """Settings of Newton's method."""

    tolerance: float
    """Largest residual of a root, metres."""
    max_steps: int
    """Maximum number of steps from one start."""


@dataclass
class _Found:
    """Roots, in any order."""

    query: Tensor
    """[M]."""
    numbers: Tensor
    """[M], flat index of the grid cell."""
    canonical: Tensor
    """[3, M], metres."""
    inverse: Tensor
    """[3, 3, M], of dd/dx at the root."""


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
        max_steps: maximum number of Newton steps from one start.

    Returns:
        The roots of all queries, without duplicates; those of one query in the order of their cells.
    """
    batch, count = points.shape[:2]
    if active_cells is None:
        numbers = torch.arange((shape[0] - 1) * (shape[1] - 1) * (shape[2] - 1), device=points.device)
    else:
        numbers = active_cells.reshape(-1).nonzero()[:, 0]
    solver = _Solver(tolerance, max_steps)
    found = [_Found(numbers[:0], numbers[:0], points.new_empty(3, 0), points.new_empty(3, 3, 0))]
    # Several poses are processed together, as far as memory allows.
    poses_at_once = max(1, min(_CELLS_AT_ONCE // max(len(numbers), 1), _QUERIES_AT_ONCE // max(count, 1)))
    for first in range(0, batch if count else 0, poses_at_once):
        poses = slice(first, first + poses_at_once)
        for some in numbers.split(_CELLS_AT_ONCE):
            cells = _cells_of(transforms[poses], some, grid, shape)
            boxes = polynomial_boxes(cells.polynomials)
            for start in range(0, count, _QUERIES_AT_ONCE):
                queries = points[poses, start : start + _QUERIES_AT_ONCE]
                flat, width = queries.reshape(-1, 3).T.contiguous(), queries.shape[1]
                for query, cell in pairs_in_boxes(flat, *boxes, len(queries)):
                    for part in _search(flat, query, cell, cells, solver):
                        part.query = (first + part.query // width) * count + start + part.query % width
                        found.append(part)
    return _sorted(found, _SAME_ROOT * float(grid.cell_size(shape).min()))


def _cells_of(transforms: Tensor, numbers: Tensor, grid: CanonicalGrid, shape: tuple[int, int, int]) -> _Cells:
    """Return cells in G poses, one pose after the other, from the transforms [G, D * H * W, 12] of the nodes."""
    corners, size = cell_corners(numbers, shape), grid.cell_size(shape)
    centres = grid.nodes(shape).reshape(-1, 3)[corners[:, 0]] + size / 2
    centres = centres.T.repeat(1, len(transforms))
    polynomials = cell_polynomials(transforms[:, corners].reshape(-1, 8, 12), centres, size)
    return _Cells(polynomials, centres, numbers.repeat(len(transforms)), size)


def _search(points: Tensor, query: Tensor, cell: Tensor, cells: _Cells, solver: _Solver) -> Iterator[_Found]:
    """Yield the roots of queries in cells.

    Args:
        points: [3, N], queries.
        query, cell: [P], indices of pairs with the query in the cell's posed box, cell by cell.
        cells: the cells.
        solver: settings.
    """
    used, cell = cell.unique_consecutive(return_inverse=True)
    cells = cells.take(used)
    pairs, tame = _possible(points, query, cell, cells)
    yield from _solve(points, pairs.take(tame.nonzero()[:, 0]), cells, solver)
    for some in pairs.take((~tame).nonzero()[:, 0]).split():
        if cells.level == _LEVELS:
            yield from _solve(points, _with_many_starts(some), cells, solver)
        else:
            yield from _search(points, *_pairs_with_eighths(points, some, cells), solver)


def _possible(points: Tensor, query: Tensor, cell: Tensor, cells: _Cells) -> tuple[_Pairs, Tensor]:
    """Return the pairs that Newton's first step from the centre does not rule out, and whether their cells are tame, [P]."""
    bounds = bound_roots(cells.polynomials, cells.level)
    kept = [_Pairs(query[:0], cell[:0], points[:, :0])]
    for some in _Pairs(query, cell, points.new_empty(0, len(query))).split():
        offset = pick(points, some.query) - pick(cells.polynomials[0, 0, 0], some.cell)
        some.start = (pick(bounds.inverse, some.cell) * offset).sum(1)
        kept.append(some.take((some.start.abs() <= pick(bounds.reach, some.cell)).all(0).nonzero()[:, 0]))
    pairs = _Pairs(*(torch.cat([getattr(part, name) for part in kept], -1) for name in ("query", "cell", "start")))
    return pairs, pick(bounds.curvature < _TAME, pairs.cell)


def _pairs_with_eighths(points: Tensor, pairs: _Pairs, cells: _Cells) -> tuple[Tensor, Tensor, _Cells]:
    """Cut the cells of pairs into eight; return pairs (query [K], eighth [K]) that may hold a root, and the eighths."""
    whole, place = pairs.cell.unique_consecutive(return_inverse=True)
    eighths = cells.take(whole).cut()
    cell = place + len(whole) * torch.arange(8, device=place.device)[:, None]  # [8, P]
    offset = pick(points, pairs.query)[:, None] - eighths.polynomials[0, 0, 0][:, cell]
    inside = (offset.abs() <= bound_boxes(eighths.polynomials, eighths.level)[:, cell]).all(0)
    return pairs.query.expand(8, -1)[inside], cell[inside], eighths


def _with_many_starts(pairs: _Pairs) -> _Pairs:
    """Return each pair ten times: with its own start, the cell's centre and its corners."""
    corners = CORNERS.to(pairs.start) - 0.5
    fixed = torch.cat([torch.zeros_like(corners[:1]), corners]).T
    starts = torch.cat([pairs.start[:, None], fixed[..., None].expand(-1, -1, len(pairs.query))], 1)
    copies = starts.shape[1]
    return _Pairs(pairs.query.repeat(copies), pairs.cell.repeat(copies), starts.flatten(1))


def _solve(points: Tensor, pairs: _Pairs, cells: _Cells, solver: _Solver) -> Iterator[_Found]:
    """Yield the roots that Newton's method finds from the starts of pairs."""
    size = cells.size[:, None]
    for some in pairs.split():
        residuals = pick(cells.polynomials, some.cell)
        residuals[0, 0, 0] -= pick(points, some.query)
        for index, local, inverse in _newton(residuals, some.start.clamp(-0.5, 0.5), cells.level, solver):
            cell = pick(some.cell, index)
            canonical = pick(cells.centres, cell) + size * local
            yield _Found(pick(some.query, index), pick(cells.numbers, cell), canonical, inverse * size[..., None])


def _newton(residuals: Tensor, local: Tensor, level: int, solver: _Solver) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Run Newton's method for a root of each polynomial in its cell.

    Args:
        residuals: [3, 3, 3, 3, P], polynomials of d(s) - x'.
        local: [3, P], starts, cell coordinates.
        level: how often the cells were cut.
        solver: settings.

    Yields:
        The indices [M] of polynomials with a root, the root [3, M], and the inverse [3, 3, M] of dd/ds there.

    Source: SNARF Eq. 6, with the exact Jacobian.
    """
    dtype = local.dtype
    reach = 0.5 + FACE_TOLERANCE[dtype] * 2**level
    index = torch.arange(local.shape[1], device=local.device)
    for steps in range(1, solver.max_steps + 1):
        is_last = steps == solver.max_steps
        residual, *derivatives = evaluate(residuals, local)
        inverse, _ = inverse_of(*derivatives)
        step = (inverse * residual).sum(1)
        longest = step.abs().amax(0)
        # Where the Jacobian is singular there is no inverse to report.
        is_exact = longest < (torch.inf if is_last else _LAST_STEP[dtype])
        converged = (residual.square().sum(0) < solver.tolerance**2) & is_exact
        moves = longest < _TRUSTED if is_last else torch.ones_like(converged)
        local = torch.where(moves, local - step / longest.clamp_min(1), local)
        from_centre = local.abs().amax(0)
        done = (converged & (from_centre <= reach)).nonzero()[:, 0]
        yield pick(index, done), pick(local, done), pick(inverse, done)
        # Steps grow shorter towards a root: one that ends farther outside the cell than its length will not return.
        going = (~converged & (from_centre - 0.5 <= longest.clamp_max(_STRAY))).nonzero()[:, 0]
        if not len(going):
            return
        index, local, residuals = (pick(values, going) for values in (index, local, residuals))


def _sorted(found: list[_Found], same: float) -> Roots:
    """Return the roots sorted by query and cell, without duplicates: those closer together than `same`, metres."""
    numbers, query = (torch.cat([getattr(part, name) for part in found]) for name in ("numbers", "query"))
    canonical = torch.cat([part.canonical for part in found], 1)
    inverse = torch.cat([part.inverse for part in found], 2)
    order = torch.argsort(canonical[0])
    for key in (numbers, query):
        order = order[torch.argsort(key[order], stable=True)]
    roots = Roots(pick(canonical, order).T, query[order], pick(inverse, order).permute(2, 0, 1))
    # The two roots beside a fold may be close together too, but differ in orientation.
    return drop_duplicates(roots, same, by_orientation=True)
