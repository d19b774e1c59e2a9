"""Comparison of the roots of a search with the true roots."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from scenes import Scene
from searches import Found

from ground_truth import GroundTruth, blended_nodes, locate_cells  # isort: skip (scenes puts its folder on the path)
from ground_truth import field as skin_field  # isort: skip

__all__ = ["MATCH_M", "MISS_KINDS", "Scores", "score"]

MATCH_M = 1e-3
"""A true root is found if a root of the search is at most this far away, metres; each root of the search counts once."""

_ON_FACE = 2e-4  # of a cell: how far outside the cell of its search a float32 root is accepted

MISS_KINDS = ("another root of the query in its cell", "det J changes sign in its cell", "other cells")
"""Places of a missed root; the first that fits is counted."""


@dataclass
class Scores:
    """Counts of one search; they can be added up over scenes."""

    queries: int = 0
    """Queries that are not on a seam."""
    seams: int = 0
    """Queries on a seam, left out of all other counts."""
    roots: int = 0
    """True roots."""
    found: int = 0
    """True roots that were found."""
    positive: int = 0
    """True roots with det J > 0."""
    found_positive: int = 0
    """True roots with det J > 0 that were found."""
    duplicates: int = 0
    """Roots beside a true one that another root was matched to."""
    false: int = 0
    """Roots without a true root nearby."""
    inside: int = 0
    """Queries inside the shape, by the union over the true roots."""
    wrong: int = 0
    """Queries that the roots of the search label differently."""
    wrong_sets: int = 0
    """The same with the label of the true root for every matched root: the effect of missing and false roots alone."""
    jacobian_errors: list[np.ndarray] = field(default_factory=list)
    """Relative errors of J^-1 at matched roots, Frobenius norm, to the nearest of those of the cells that meet there."""
    missed: np.ndarray = field(default_factory=lambda: np.zeros((2, len(MISS_KINDS)), np.int64))
    """Missed roots by `MISS_KINDS`: with det J > 0, and with det J < 0."""

    def __add__(self, other: Scores) -> Scores:
        return Scores(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def score(found: Found, truth: GroundTruth, scene: Scene, active: np.ndarray | None, true_inside: np.ndarray) -> Scores:
    """Compare roots with the true roots.

    Args:
        found: of the search.
        truth: of the same queries, in the active cells.
        scene: its field and shape.
        active: the cells that count, bool [D-1, H-1, W-1]; None for all. A root elsewhere is not held against a search.
        true_inside: whether each true root is inside the shape, [M].
    """
    count = len(truth.seam)
    use, true = (~truth.seam[roots.query] for roots in (found, truth))
    canonical, query = found.canonical[use].astype(np.float64), found.query[use]
    match, taken, is_near = _match(query, canonical, truth)
    hit, positive, pair = match >= 0, truth.determinant > 0, match[match >= 0]

    shape, lower, upper = scene.shape, scene.grid.lower.double().numpy(), scene.grid.upper.double().numpy()
    nodes = blended_nodes(scene.weights.numpy(), scene.transforms.numpy())
    cell, _ = locate_cells(canonical, shape, lower, upper)
    relevant = np.ones(len(query), bool) if active is None else active.reshape(-1)[cell]
    inverse = found.jacobian_inverse[use][pair].astype(np.float64)
    errors = _relative(inverse, truth.jacobian_inverse[hit])
    cells = np.array(shape[::-1]) - 1
    for corner in np.ndindex(2, 2, 2):  # the cells around a root that lies almost on a face: each has its own Jacobian
        aside = canonical[pair] + (np.array(corner) * 2 - 1) * _ON_FACE / cells * (upper - lower)
        beside, offset = locate_cells(aside, shape, lower, upper)
        offset += (canonical[pair] - aside) / (upper - lower) * cells
        jacobian = skin_field(nodes, shape, lower, upper, beside, offset)[1]
        errors = np.minimum(errors, _relative(inverse, np.linalg.inv(jacobian)))
    label = scene.occupied(canonical) if len(canonical) else np.zeros(0, bool)
    wanted, got = _union(truth.query[true], true_inside[true], count), _union(query, label, count)
    label[pair] = true_inside[hit]
    got_sets = _union(query, label, count)

    kinds = np.zeros((2, len(MISS_KINDS)), np.int64)
    lost = (~hit & true).nonzero()[0]
    if len(lost):
        np.add.at(kinds, (np.where(positive[lost], 0, 1), _miss_kinds(truth, lost, nodes, shape, lower, upper)), 1)
    return Scores(
        queries=int((~truth.seam).sum()),
        seams=int(truth.seam.sum()),
        roots=int(true.sum()),
        found=int((hit & true).sum()),
        positive=int((positive & true).sum()),
        found_positive=int((hit & positive & true).sum()),
        duplicates=int((~taken & is_near).sum()),
        false=int((~taken & ~is_near & relevant).sum()),
        inside=int(wanted.sum()),
        wrong=int((got != wanted).sum()),
        wrong_sets=int((got_sets != wanted).sum()),
        jacobian_errors=[errors],
        missed=kinds,
    )


def _relative(inverse: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the distance [M] of matrices [M, 3, 3] from the true ones."""
    return np.linalg.norm(inverse - right, axis=(1, 2)) / np.linalg.norm(right, axis=(1, 2))


def _match(query: np.ndarray, canonical: np.ndarray, truth: GroundTruth):
    """Match found roots one for one with true ones of the same query, the nearest pairs first.

    Returns:
        For each true root the index of its match, or -1; for each found root whether it was matched, and whether a true root
        is near enough to be matched.
    """
    first = np.searchsorted(truth.query, query, "left")
    counts = np.searchsorted(truth.query, query, "right") - first
    mine = np.repeat(np.arange(len(query)), counts)
    theirs = first[mine] + np.arange(len(mine)) - (np.cumsum(counts) - counts)[mine]
    distance = np.linalg.norm(canonical[mine] - truth.canonical[theirs], axis=1)
    near = distance < MATCH_M
    mine, theirs = mine[near], theirs[near]
    match, taken = np.full(len(truth.query), -1), np.zeros(len(query), bool)
    is_near = np.bincount(mine, minlength=len(query)) > 0
    for i in np.argsort(distance[near], kind="stable"):
        if not taken[mine[i]] and match[theirs[i]] < 0:
            taken[mine[i]], match[theirs[i]] = True, mine[i]
    return match, taken, is_near


def _miss_kinds(truth: GroundTruth, lost: np.ndarray, nodes, shape, lower, upper) -> np.ndarray:
    """Return the index in `MISS_KINDS` of each missed root."""
    key = truth.query * (int(truth.cell.max()) + 1) + truth.cell
    crowded = (np.searchsorted(np.sort(key), key[lost], "right") - np.searchsorted(np.sort(key), key[lost], "left")) > 1
    at = (np.arange(5) + 0.5) / 5
    places = np.stack(np.meshgrid(at, at, at), -1).reshape(-1, 3)
    cells = np.repeat(truth.cell[lost], len(places))
    jacobian = skin_field(nodes, shape, lower, upper, cells, np.tile(places, (len(lost), 1)))[1]
    sign = np.sign(np.linalg.det(jacobian)).reshape(len(lost), -1)
    folded = sign.min(1) != sign.max(1)
    return np.where(crowded, 0, np.where(folded, 1, 2))


def _union(query: np.ndarray, flags: np.ndarray, count: int) -> np.ndarray:
    """Return [count] bool: one of the query's flags is set."""
    return np.bincount(query[flags], minlength=count) > 0
