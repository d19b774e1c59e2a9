"""Normals of points: their directions from planes through neighbours, their sides from the winding number.

Neighbours along a minimum spanning tree agree about their side, cheapest where their planes are parallel (Hoppe et al., Surface
Reconstruction from Unorganized Points, SIGGRAPH 1992). This is unsure between thin sheets, such as the sides of a hand, and
between parts that touch, so the tree is cut at its unsure edges. The sides of the patches that are left are chosen together: on
a closed surface with outward normals the winding number is one half everywhere (`winding.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from snarfcli.point_clouds.neighbours import find_neighbours, plane_normals, point_areas
from snarfcli.point_clouds.winding import WindingProbes

__all__ = ["CheckedNormals", "check_normals", "estimate_normals"]

Array = NDArray[np.float64]

_PLANE_NEIGHBOURS = 10
_TREE_NEIGHBOURS = 8
_UNSURE = 0.6  # cosine between the normals of neighbours below which their sides are chosen apart
_LEAST_PATCH = 8  # points
_LEAST_COST = 1e-6  # of an edge; SciPy takes 0 for no edge
_NO_NORMALS = 0.6  # median cosine between given and estimated normals; that of random directions is 0.5
_CLEARLY = 0.7  # share of the misfit: other sides are taken only if they are so much better


@dataclass(frozen=True)
class CheckedNormals:
    """Outward normals, and what was done to those that were given."""

    normals: Array
    """[N, 3], unit length, outward."""
    change: str
    """What was changed, for messages, such as "pointed inward and were turned"; empty if nothing was."""


def estimate_normals(points: Array) -> Array:
    """Return the outward unit normals [N, 3] of points on one or more surfaces, also open ones.

    Args:
        points: [N, 3], any unit.

    Raises:
        ValueError: there are fewer than 16 points, or one is not finite.
    """
    points = np.asarray(points, np.float64)
    _, neighbours = find_neighbours(points, max(_PLANE_NEIGHBOURS, _TREE_NEIGHBOURS))
    normals = plane_normals(points, neighbours[:, :_PLANE_NEIGHBOURS])
    signs, patches = _patches(normals, neighbours[:, :_TREE_NEIGHBOURS])
    normals = normals * signs[:, None]
    probes = WindingProbes.of(points, point_areas(points))
    return normals * _sides(probes, normals, patches)[patches, None]


def check_normals(points: Array, normals: Array) -> CheckedNormals:
    """Return outward normals, made from given ones, which may point inward, to both sides, or be no normals at all.

    Args:
        points: [N, 3], any unit.
        normals: [N, 3], of any length.

    Raises:
        ValueError: as `estimate_normals`.
    """
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    estimated = estimate_normals(points)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    is_given = np.isfinite(length[:, 0]) & (length[:, 0] > 0)
    given = np.where(is_given[:, None], normals, estimated) / np.where(is_given[:, None], length, 1.0)
    along = (given * estimated).sum(axis=1)
    if np.median(np.abs(along)) < _NO_NORMALS or not is_given.any():
        return CheckedNormals(estimated, "were not normal to the surface and were estimated anew")
    missing = "" if is_given.all() else f"were missing at {np.count_nonzero(~is_given)} points and were estimated there"
    probes = WindingProbes.of(points, point_areas(points))
    one_sided = given * np.where(along < 0, -1.0, 1.0)[:, None]
    misfit = [probes.misfit(candidate) for candidate in (given, -given, one_sided)]
    best = int(np.argmin(misfit))
    if best == 0 or misfit[best] > _CLEARLY * misfit[0]:
        return CheckedNormals(given, missing)
    if best == 1 or misfit[1] < misfit[2] / _CLEARLY:
        return CheckedNormals(-given, "pointed inward and were turned")
    return CheckedNormals(one_sided, "pointed to both sides and were turned outward")


def _patches(normals: Array, neighbours: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
    """Return the signs [N] with which normals [N, 3] agree within patches, and the number of the patch of each point [N].

    Args:
        normals: of either sign.
        neighbours: [N, K].
    """
    count, width = neighbours.shape
    starts = np.repeat(np.arange(count), width)
    cost = 1 - np.abs((normals[starts] * normals[neighbours.ravel()]).sum(axis=1)) + _LEAST_COST
    graph = csr_matrix((cost, (starts, neighbours.ravel())), (count, count))
    tree = minimum_spanning_tree(graph.maximum(graph.T))
    tree = tree + tree.T
    signs, patches, patch_count = np.ones(count), np.full(count, -1), 0
    for root in range(count):
        if patches[root] < 0:
            order, before = breadth_first_order(tree, root, directed=False)
            signs[order], numbers = _cut_tree(normals, order, before)
            patches[order] = patch_count + numbers
            patch_count += int(numbers.max()) + 1
    return signs, patches


def _cut_tree(normals: Array, order: NDArray, before: NDArray) -> tuple[Array, NDArray[np.intp]]:
    """Return the signs [K] and the numbers of the patches [K] of the points of one tree.

    Args:
        normals: [N, 3], of all points.
        order: [K], numbers of the tree's points; each comes after the one before it on the way from the root.
        before: [N], the point before each point.
    """
    place = np.empty(len(normals), np.intp)
    place[order] = np.arange(len(order))
    parents = [-1, *place[before[order[1:]]].tolist()]
    along = np.concatenate([[1.0], (normals[order[1:]] * normals[before[order[1:]]]).sum(axis=1)])
    is_unsure = (np.abs(along) < _UNSURE).tolist()
    below, left = [1] * len(order), len(order)
    is_cut = [False] * len(order)
    for child in range(len(order) - 1, 0, -1):
        if is_unsure[child] and below[child] >= _LEAST_PATCH and left - below[child] >= _LEAST_PATCH:
            is_cut[child] = True
            left -= below[child]
        else:
            below[parents[child]] += below[child]
    turns = np.where(along < 0, -1.0, 1.0).tolist()
    signs, numbers, patch_count = [1.0] * len(order), [0] * len(order), 1
    for child in range(1, len(order)):
        parent = parents[child]
        signs[child] = signs[parent] * turns[child]
        numbers[child] = patch_count if is_cut[child] else numbers[parent]
        patch_count += is_cut[child]
    return np.array(signs), np.array(numbers, np.intp)


def _sides(probes: WindingProbes, normals: Array, patches: NDArray[np.intp]) -> Array:
    """Return the sign [P] of each patch with which the winding number is closest to one half at the probes.

    It starts from what each patch does alone, and turns the patch that helps most until none does.
    """
    of_patches = probes.by_group(normals, patches)  # [M, P]
    gram = of_patches.T @ of_patches
    alone = np.array([of_patches[patches[probes.numbers] == patch, patch].sum() for patch in range(of_patches.shape[1])])
    signs = np.where(alone < 0, -1.0, 1.0)
    for _ in range(4 * len(signs)):
        rest = gram @ signs - 0.5 * of_patches.sum(axis=0)
        gain = signs * rest - np.diag(gram)
        best = int(np.argmax(gain))
        if gain[best] <= 1e-9 * gram.trace():
            break
        signs[best] = -signs[best]
    return signs
