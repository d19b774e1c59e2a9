"""Every root of d(x) = T(x) [x; 1] = x' in a trilinear grid, in float64, and which queries have no settled number of them.

DESIGN. Inside a cell each component of d is a polynomial of degree at most two along each axis, so 27 Bernstein coefficients
hold it, and its values lie in their convex hull; the same holds for every sub-box after de Casteljau's subdivision. A pair of
query and box is dropped when one of nine linear functions (the axes, the singular directions of the Jacobian J at the centre,
the rows of its inverse Y) separates the query from the hull. A box is *simple* when the hull of J gives |I - Y J| <= 1/2 in
the maximum norm: then there is at most one root in it, and x <- clamp(x - Y (d(x) - x')) halves the distance to it at every
step, because clamping to the box brings no coordinate further from a point in the box. Other boxes are cut into eight.

What is left after the last cut lies within about `seam` of a fold. A query is called *on a seam* when moving it by `seam`
might change how many roots it has: beside a fold inside a cell or on a face between cells, or where a root leaves the cells
that are searched. Comparisons leave those queries out and say how many they are.

Nothing here comes from the library; it is slow (some 2,000 queries a second) and has no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

__all__ = ["GroundTruth", "blended_nodes", "field", "locate_cells", "true_roots"]

Array = NDArray[np.float64]

_SIMPLE = 0.5  # largest |I - Y J| of a simple box
_STEPS = 60  # halvings: 1e-18 of a box
_RESIDUAL = 1e-11  # metres, of a polished root; float64 leaves 1e-15 times its coordinates
_OUTSIDE = 1e-9  # of a cell, by which a polished root may lie outside its box; the neighbour finds it too
_SAME = 1e-8  # metres between two copies of one root
_GROUP = 48  # queries that go through the first cull together
_CELLS_AT_ONCE = 1024
_PAIRS_AT_ONCE = 400_000

# Bits of a corner's or child's number k: x, y, z; indices of Bernstein coefficients run z, y, x, x fastest.
_BITS = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], np.float64)


def _kron(z: Array, y: Array, x: Array) -> Array:
    return reduce(np.kron, (z, y, x))


def _constants():
    """Return constant matrices that act on 27 values or Bernstein coefficients."""
    at = np.array([0.0, 0.5, 1.0])
    linear = np.stack([1 - at, at], 1)  # [3, 2]: weights of both ends at 0, 1/2, 1
    trilinear = _kron(linear, linear, linear)  # [27, 8]: values at the 27 points from those at the corners
    fit = np.array([[1, 0, 0], [-0.5, 2, -0.5], [0, 0, 1.0]])  # values of a quadratic at 0, 1/2, 1 -> coefficients
    halves = np.array([[[1, 0, 0], [0.5, 0.5, 0], [0.25, 0.5, 0.25]], [[0.25, 0.5, 0.25], [0, 0.5, 0.5], [0, 0, 1.0]]])
    children = np.stack([_kron(halves[int(z)], halves[int(y)], halves[int(x)]) for x, y, z in _BITS])  # [8, 27, 27]
    one, slope = np.eye(3), 2.0 * np.array([[-1, 1, 0], [0, -1, 1.0]])
    slopes = np.stack([_kron(one, one, slope), _kron(one, slope, one), _kron(slope, one, one)])  # [3, 18, 27]
    places = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1).reshape(27, 3)[:, ::-1]  # x, y, z of the 27 points
    return trilinear, _kron(fit, fit, fit), children, slopes, places


_TRILINEAR, _FIT, _CHILDREN, _SLOPES, _PLACES = _constants()


@dataclass(frozen=True)
class GroundTruth:
    """All roots of N queries under one pose."""

    canonical: Array
    """[M, 3], metres, float64."""
    query: NDArray[np.int64]
    """Index of each root's query, [M], ascending."""
    determinant: Array
    """det of dd/dx at each root, [M]; positive where the map keeps orientation."""
    jacobian_inverse: Array
    """[M, 3, 3], of dd/dx in the root's cell; on a face between cells, of one of them."""
    cell: NDArray[np.int64]
    """Flat cell of each root, x fastest, [M]."""
    seam: NDArray[np.bool_]
    """[N]: moving the query by the `seam` that was asked for might change how many roots it has."""

    def of(self, query: int) -> Array:
        """Return the roots [K, 3] of one query."""
        return self.canonical[self.query == query]

    @property
    def folded_cells(self) -> int:
        """In how many (query, cell) pairs there are two roots or more."""
        _, counts = np.unique(np.stack([self.query, self.cell]), axis=1, return_counts=True)
        return int((counts > 1).sum())


def blended_nodes(weights: Array, bone_transforms: Array) -> Array:
    """Return the blended transforms [D * H * W, 3, 4] of one pose in float64 (Fast-SNARF Eq. 13).

    Args:
        weights: [D, H, W, J].
        bone_transforms: [J, 4, 4].
    """
    rows = np.asarray(bone_transforms, np.float64)[:, :3].reshape(-1, 12)
    return (np.asarray(weights, np.float64).reshape(-1, len(rows)) @ rows).reshape(-1, 3, 4)


def field(nodes: Array, shape: tuple[int, int, int], lower: Array, upper: Array, cell: Array, local: Array):
    """Evaluate d and its Jacobian by the canonical point, inside cells.

    Args:
        nodes: [D * H * W, 3, 4], from `blended_nodes`.
        shape: (D, H, W).
        lower, upper: the grid's box, [3], metres.
        cell: flat cell numbers, x fastest, [M].
        local: coordinates in the cell, [M, 3].

    Returns:
        d [M, 3], metres, and dd/dx [M, 3, 3].
    """
    index, first = _first_nodes(cell, shape)
    size = (upper - lower) / (np.array(shape[::-1]) - 1)
    canonical = lower + (index + local) * size
    homogeneous = np.concatenate([canonical, np.ones((len(canonical), 1))], 1)
    corners = nodes[first[:, None] + _offsets(shape)]  # [M, 8, 3, 4]
    share = np.where(_BITS > 0, local[:, None], 1 - local[:, None])  # [M, 8, 3]
    sign = np.where(_BITS > 0, 1.0, -1.0)
    blended = np.einsum("mk,mkrc->mrc", share.prod(2), corners)
    jacobian = blended[:, :, :3].copy()
    for axis in range(3):
        others = share[:, :, [a for a in range(3) if a != axis]].prod(2) * sign[:, axis]
        slope = np.einsum("mk,mkrc->mrc", others, corners)
        jacobian[:, :, axis] += np.einsum("mrc,mc->mr", slope, homogeneous) / size[axis]
    return np.einsum("mrc,mc->mr", blended, homogeneous), jacobian


def locate_cells(canonical: Array, shape: tuple[int, int, int], lower: Array, upper: Array):
    """Return the flat cell [M] that holds each canonical point [M, 3], the nearest for a point outside, and its coordinates."""
    cells = np.array(shape[::-1]) - 1
    scaled = (canonical - lower) / (upper - lower) * cells
    index = np.clip(np.floor(scaled), 0, cells - 1).astype(np.int64)
    return (index[:, 2] * cells[1] + index[:, 1]) * cells[0] + index[:, 0], scaled - index


def true_roots(
    points: Array,
    weights: Array,
    bone_transforms: Array,
    lower: Array,
    upper: Array,
    *,
    active_cells: NDArray[np.bool_] | None = None,
    seam: float = 1e-9,
) -> GroundTruth:
    """Find all roots of one pose.

    Args:
        points: queries [N, 3], posed space, metres. Non-finite ones have no root.
        weights: skinning weights [D, H, W, J] at the nodes.
        bone_transforms: [J, 4, 4], canonical to posed.
        lower, upper: the grid's box, [3], metres.
        active_cells: [D-1, H-1, W-1], cells to search; None for all.
        seam: how far a query may be moved without a change in the number of its roots, metres, lest it be called on a seam.
    """
    points, lower, upper = (np.asarray(a, np.float64) for a in (points, lower, upper))
    depth, height, width = np.shape(weights)[:3]
    shape = (depth, height, width)
    nodes = blended_nodes(weights, bone_transforms)
    if not np.isfinite(nodes).all():
        raise ValueError("weights and bone_transforms must be finite")
    total = (depth - 1) * (height - 1) * (width - 1)
    active = np.ones(total, bool) if active_cells is None else np.asarray(active_cells, bool).reshape(-1)
    size = (upper - lower) / (np.array(shape[::-1]) - 1)
    search = _Search(points, seam, int(np.ceil(np.log2(np.sqrt(size.max() / seam)))) + 2)
    groups = _Groups(points)
    cells = active.nonzero()[0]
    for start in range(0, len(cells), _CELLS_AT_ONCE):
        some = cells[start : start + _CELLS_AT_ONCE]
        index, first = _first_nodes(some, shape)
        corners = nodes[first[:, None] + _offsets(shape)].reshape(-1, 8, 12)
        at = (_TRILINEAR @ corners).reshape(-1, 27, 3, 4)
        canonical = lower + (index[:, None] + _PLACES) * size
        values = np.einsum("ktrc,ktc->ktr", at[..., :3], canonical) + at[..., 3]
        coefficients = _FIT @ values
        for query, box in groups.candidates(coefficients.min(1) - seam, coefficients.max(1) + seam):
            search.descend(query, box, coefficients, some)
    return _settle(search, nodes, shape, lower, upper, active)


def _first_nodes(cell: NDArray[np.int64], shape: tuple[int, int, int]):
    """Return the index (x, y, z) [M, 3] of each cell and the flat number [M] of its first node."""
    _depth, height, width = shape
    x, y, z = cell % (width - 1), cell // (width - 1) % (height - 1), cell // ((width - 1) * (height - 1))
    return np.stack([x, y, z], 1), (z * height + y) * width + x


def _offsets(shape: tuple[int, int, int]) -> NDArray[np.int64]:
    """Return the flat node offsets [8] of a cell's corners from its first node."""
    return (_BITS @ np.array([1, shape[2], shape[1] * shape[2]])).astype(np.int64)


class _Groups:
    """Queries in small groups with a box around each, for a quick first cull."""

    def __init__(self, points: Array) -> None:
        known = np.isfinite(points).all(1).nonzero()[0]
        near = points[known]
        if len(near):
            scaled = (near - near.min(0)) / np.maximum(np.ptp(near, axis=0), 1e-12) * 1023
            bits = (scaled.astype(np.int64)[:, :, None] >> np.arange(10)) & 1
            morton = (bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum((1, 2))
            order = np.argsort(morton, kind="stable")
            known, near = known[order], near[order]
        self.known, self.points = known, near
        starts = np.arange(0, len(known), _GROUP)
        self.starts, self.ends = starts, np.append(starts[1:], len(known))
        if len(starts):
            self.lower = np.minimum.reduceat(near, starts)
            self.upper = np.maximum.reduceat(near, starts)

    def candidates(self, lower: Array, upper: Array):
        """Yield pairs (query [P], box [P]) with the query inside the box, boxes [K, 3]."""
        if not len(self.starts):
            return
        touching = np.ones((len(self.starts), len(lower)), bool)
        for axis in range(3):
            touching &= self.lower[:, None, axis] <= upper[:, axis]
            touching &= self.upper[:, None, axis] >= lower[:, axis]
        group, box = touching.nonzero()
        order = np.argsort(box, kind="stable")
        group, box = group[order], box[order]
        at_once = max(1, _PAIRS_AT_ONCE // _GROUP)
        for start in range(0, len(group), at_once):
            some, boxes = group[start : start + at_once], box[start : start + at_once]
            counts = self.ends[some] - self.starts[some]
            owner = np.repeat(np.arange(len(some)), counts)
            at = self.starts[some][owner] + np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]
            query, pair_box = self.points[at], boxes[owner]
            inside = ((query >= lower[pair_box]) & (query <= upper[pair_box])).all(1)
            if inside.any():
                yield self.known[at[inside]], pair_box[inside]


class _Search:
    """Subdivision of cells for their queries; collects roots, near misses and undecided queries."""

    def __init__(self, points: Array, seam: float, levels: int) -> None:
        self.points, self.seam, self.levels = points, seam, levels
        self.undecided = np.zeros(len(points), bool)
        # query, cell, coordinates in the cell, and whether it is a root or only nearly one
        self.found: list[tuple[Array, Array, Array, Array]] = []

    def descend(self, query: Array, box: Array, coefficients: Array, cells: Array) -> None:
        """Find the roots of pairs of query [P] and cell [P], a number into `coefficients` [K, 27, 3] and `cells` [K]."""
        used, box = np.unique(box, return_inverse=True)
        coefficients, cell, low, side = coefficients[used], cells[used], np.zeros((len(used), 3)), 1.0
        for level in range(self.levels + 1):
            bounds = _Bounds(coefficients)
            keep = bounds.may_reach(self.points[query], box, self.seam)
            query, box = query[keep], box[keep]
            simple = bounds.is_simple[box]
            self._solve(query[simple], box[simple], coefficients, bounds.inverse, bounds.bound, cell, low, side)
            query, box = query[~simple], box[~simple]
            if not len(query):
                return
            if level == self.levels:
                break
            used, box = np.unique(box, return_inverse=True)
            side /= 2
            coefficients = (_CHILDREN @ coefficients[used][:, None]).reshape(-1, 27, 3)
            low = (low[used][:, None] + side * _BITS).reshape(-1, 3)
            cell = np.repeat(cell[used], 8)
            least, most = coefficients.min(1) - self.seam, coefficients.max(1) + self.seam
            pairs = []
            for child in range(8):
                at, target = box * 8 + child, self.points[query]
                inside = ((target >= least[at]) & (target <= most[at])).all(1)
                pairs.append((query[inside], at[inside]))
            query, box = (np.concatenate(part) for part in zip(*pairs, strict=True))
            if not len(query):
                return
            used, box = np.unique(box, return_inverse=True)
            coefficients, low, cell = coefficients[used], low[used], cell[used]
        self.undecided[query] = True

    def _solve(self, query, box, coefficients, inverse, bound, cell, low, side) -> None:
        """Find the root, if there is one, of each pair of query [P] and simple box [P]."""
        if not len(query):
            return
        x = np.full((len(query), 3), 0.5)
        going = np.arange(len(query))
        for _ in range(_STEPS):
            at = box[going]
            posed = (_basis(x[going])[:, None] @ coefficients[at])[:, 0]
            newton = x[going] - (inverse[at] @ (posed - self.points[query[going]])[:, :, None])[:, :, 0]
            moved = np.clip(newton, 0, 1)
            step = np.abs(moved - x[going]).max(1)
            x[going] = moved
            # A root in the box is at most bound * (diameter 1) from any Newton iterate; a near miss lies seam / sigma outside.
            reach = bound[at] + 10 * self.seam * np.abs(inverse[at]).sum(2).max(1) + 1e-6
            lost = np.abs(newton - moved).max(1) > reach
            x[going[lost]] = np.nan
            going = going[(step > 1e-15) & ~lost]
            if not len(going):
                break
        kept = np.isfinite(x[:, 0])
        query, box, x = query[kept], box[kept], x[kept]
        clamped = x.copy()
        # Polish with the exact Jacobian, not clamped: twins in neighbouring boxes then agree to rounding.
        for _ in range(3):
            posed = _evaluate(coefficients[box], x)[0]
            jacobian = _evaluate(coefficients[box], np.clip(x, 0, 1))[1]  # regular in the box, perhaps not outside
            step = np.linalg.solve(jacobian, (posed - self.points[query])[:, :, None])[:, :, 0]
            x = np.where(np.abs(step).max(1, keepdims=True) < 0.5, x - step, x)
        posed, _ = _evaluate(coefficients[box], x)
        error = np.linalg.norm(posed - self.points[query], axis=1)
        allowed = _RESIDUAL * np.maximum(1, np.abs(self.points[query]).max(1))
        root = (error < allowed) & (np.abs(x - 0.5).max(1) <= 0.5 + _OUTSIDE / side)
        at_clamped = _evaluate(coefficients[box], clamped)[0]
        missed = ~root & (np.linalg.norm(at_clamped - self.points[query], axis=1) < 3 * self.seam)
        kept = root | missed
        local = low[box] + side * np.where(root[:, None], x, clamped)
        self.found.append((query[kept], cell[box[kept]], np.clip(local[kept], 0, 1), root[kept]))


class _Bounds:
    """What the hull of the coefficients [K, 27, 3] says of each box."""

    def __init__(self, coefficients: Array) -> None:
        slopes = np.einsum("asm,kmc->kasc", _SLOPES, coefficients, optimize=True)  # [K, 3, 18, 3]
        centre = _evaluate(coefficients, np.full((len(coefficients), 3), 0.5))[1]
        u, s, vt = np.linalg.svd(centre)
        s = np.maximum(s, 1e-12 * s[:, :1] + 1e-300)
        self.inverse = np.swapaxes(vt, 1, 2) @ (np.swapaxes(u, 1, 2) / s[:, :, None])
        deviation = slopes @ np.swapaxes(self.inverse, 1, 2)[:, None] - np.eye(3)[:, None]
        self.bound = np.abs(deviation).max(2).sum(1).max(1)
        self.is_simple = self.bound <= _SIMPLE
        rows = self.inverse / np.linalg.norm(self.inverse, axis=2, keepdims=True)
        self.functions = np.concatenate([np.swapaxes(u, 1, 2), rows], 1)  # [K, 6, 3]; the axes were tested before
        values = self.functions @ np.swapaxes(coefficients, 1, 2)
        self.least, self.most = values.min(2), values.max(2)

    def may_reach(self, points: Array, box: Array, seam: float) -> Array:
        """Return [P] bool: no function separates the point [P, 3], moved by `seam`, from its box."""
        keep = np.zeros(len(points), bool)
        for start in range(0, len(points), _PAIRS_AT_ONCE):
            part = slice(start, start + _PAIRS_AT_ONCE)
            value = (self.functions[box[part]] @ points[part, :, None])[:, :, 0]
            keep[part] = ((value >= self.least[box[part]] - seam) & (value <= self.most[box[part]] + seam)).all(1)
        return keep


def _basis(x: Array) -> Array:
    """Return the 27 Bernstein polynomials at x [P, 3], [P, 27]."""
    y = 1 - x
    b = np.stack([y * y, 2 * x * y, x * x], 2)  # [P, axis, 3]
    return (b[:, 2, :, None, None] * b[:, 1, None, :, None] * b[:, 0, None, None, :]).reshape(-1, 27)


def _evaluate(coefficients: Array, x: Array):
    """Return the values [P, 3] and Jacobians [P, 3, 3] by the box coordinates, for coefficients [P, 27, 3]."""
    y = 1 - x
    b = np.stack([y * y, 2 * x * y, x * x], 2)
    g = np.stack([-2 * y, 2 * (y - x), 2 * x], 2)

    def product(z: Array, v: Array, u: Array) -> Array:
        return (z[:, :, None, None] * v[:, None, :, None] * u[:, None, None, :]).reshape(-1, 27)

    rows = [
        product(b[:, 2], b[:, 1], b[:, 0]),
        product(b[:, 2], b[:, 1], g[:, 0]),
        product(b[:, 2], g[:, 1], b[:, 0]),
        product(g[:, 2], b[:, 1], b[:, 0]),
    ]
    out = np.stack(rows, 1) @ coefficients
    return out[:, 0], np.swapaxes(out[:, 1:], 1, 2)


def _settle(search: _Search, nodes: Array, shape, lower: Array, upper: Array, active: Array) -> GroundTruth:
    """Sort the roots, drop copies, and mark the queries on a seam."""
    if search.found:
        query, cell, local, root = (np.concatenate(part) for part in zip(*search.found, strict=True))
    else:
        query, cell, local, root = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, bool)
    order = np.lexsort((cell, ~root, query))  # a query's roots before its near misses
    query, cell, local, root = query[order], cell[order], local[order], root[order]
    size = (upper - lower) / (np.array(shape[::-1]) - 1)
    canonical = lower + (_first_nodes(cell, shape)[0] + local) * size
    jacobian = field(nodes, shape, lower, upper, cell, local)[1]
    determinant = np.linalg.det(jacobian)
    inverse = np.linalg.inv(np.where(determinant[:, None, None] == 0, np.eye(3), jacobian))
    reach = search.seam * np.linalg.norm(inverse, axis=(1, 2))  # how far the root moves when the query does
    seam = search.undecided.copy()
    keep = root.copy()
    alone = ~root
    for k in range(1, len(query)):
        same = query[k:] == query[:-k]
        if not same.any():
            break
        distance = np.linalg.norm(canonical[k:] - canonical[:-k], axis=1)
        longest = np.maximum(reach[k:], reach[:-k])
        alike = np.sign(determinant[k:]) == np.sign(determinant[:-k])
        keep[k:] &= ~(same & root[k:] & keep[:-k] & alike & (distance < _SAME))
        folded = same & root[k:] & root[:-k] & ~alike & (distance < 4 * longest + _SAME)
        seam[query[k:][folded]] = True
        alone[k:] &= ~(same & root[:-k] & (distance < 8 * longest + _SAME))
    seam[query[alone]] = True  # nearly a root, and no cell that owns it
    seam[query[root & _near_border(cell, local * size, size, 2 * reach, shape, active)]] = True
    fields = canonical, query, determinant, inverse, cell
    return GroundTruth(*(values[keep] for values in fields), seam)


def _near_border(cell: Array, place: Array, size: Array, reach: Array, shape, active: Array) -> Array:
    """Return [M] bool: within `reach` [M] of a face behind which no active cell is; `place` [M, 3] in the cell, metres."""
    index = _first_nodes(cell, shape)[0]
    cells = np.array(shape[::-1]) - 1
    stride = np.array([1, cells[0], cells[0] * cells[1]])
    near = np.zeros(len(cell), bool)
    for axis in range(3):
        for step, distance in ((-1, place[:, axis]), (1, size[axis] - place[:, axis])):
            beyond = index[:, axis] + step
            exists = (beyond >= 0) & (beyond < cells[axis])
            owned = exists & active[np.where(exists, cell + step * stride[axis], 0)]
            near |= ~owned & (distance <= reach)
    return near
