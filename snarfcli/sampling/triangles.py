"""Normals of triangles and random points in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["area_normals", "random_points_in", "uniform_in_triangles"]


def area_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normals [F, 3] of triangles with `corners` [F, 3, 3]; their length is twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def random_points_in(corners: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Return one point in each triangle, uniformly distributed.

    Args:
        corners: [N, 3, 3], corners of N triangles.
        generator: source of random numbers.

    Returns:
        [N, 3], in the unit of the corners.

    Source: Osada et al., Shape Distributions, 2002, Eq. 1.
    """
    first, second = generator.random((2, len(corners), 1))
    root = np.sqrt(first)
    a, b, c = corners.transpose(1, 0, 2)
    return (1 - root) * a + root * (1 - second) * b + root * second * c


def uniform_in_triangles(
    corners: NDArray[np.float64], areas: NDArray[np.float64], count: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return `count` independent points [count, 3], uniform on triangles with `corners` [F, 3, 3] and `areas` [F]."""
    return random_points_in(corners[generator.choice(len(areas), count, p=areas / areas.sum())], generator)
