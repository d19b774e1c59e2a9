"""Triangles of marching cubes for every combination of the signs at the corners of a cell, read off from scikit-image.

Its classic table gives closed manifolds for any signs (tested on noise); the topology-aware one does not.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from skimage.measure import marching_cubes

__all__ = ["CORNERS", "EDGES", "MOST_TRIANGLES", "triangles_of_signs"]

CORNERS = tuple((number >> 2 & 1, number >> 1 & 1, number & 1) for number in range(8))
"""Places of the corners of a cell; bit k of a cell's signs says whether corner k is positive."""
EDGES = tuple((corner, axis) for axis in range(3) for corner, place in enumerate(CORNERS) if place[axis] == 0)
"""The twelve edges of a cell: the lower corner and the axis along which the edge leaves it."""
MOST_TRIANGLES = 5
"""Maximum number of triangles in a cell."""


@lru_cache(maxsize=1)
def triangles_of_signs() -> np.ndarray:
    """Return the triangles for each of the 256 combinations of signs.

    Returns:
        [256, 5, 3] int8, triples of edges, counter-clockwise seen from corners that are not positive; -1 for no triangle.
    """
    middles = np.array([2 * np.array(CORNERS[corner]) + np.eye(3, dtype=int)[axis] for corner, axis in EDGES])
    table = np.full((256, MOST_TRIANGLES, 3), -1, dtype=np.int8)
    for signs in range(1, 255):
        cell = np.array([1 if signs >> corner & 1 else -1 for corner in range(8)], dtype=np.float32).reshape(2, 2, 2)
        vertices, faces, _, _ = marching_cubes(cell, 0.0, method="lorensen", gradient_direction="ascent")
        edges = (np.rint(2 * vertices)[:, None] == middles).all(2).argmax(1)
        table[signs, : len(faces)] = edges[faces]
    return table
