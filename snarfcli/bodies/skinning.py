"""Linear blend skinning in NumPy, for meshes and for joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["blend_transforms", "skin_vertices", "transform_points"]


def skin_vertices(vertices: NDArray, weights: NDArray, transforms: NDArray) -> NDArray:
    """Move vertices by linear blend skinning, in the precision of the most precise input (SNARF Eq. 4).

    Args:
        vertices: [V, 3], metres.
        weights: [V, J], rows sum to 1.
        transforms: [..., J, 4, 4], metres, from the frame of the vertices to the frame of the result.

    Returns:
        [..., V, 3], metres.
    """
    return transform_points(blend_transforms(weights, transforms[..., :3, :]), vertices)


def blend_transforms(weights: NDArray, transforms: NDArray) -> NDArray:
    """Return the weighted sum of bone transforms for each vertex.

    Args:
        weights: [V, J].
        transforms: [..., J, R, 4] with R = 3 or 4 rows.

    Returns:
        [..., V, R, 4].
    """
    *leading, bones, rows, columns = transforms.shape
    blended = weights @ transforms.reshape(*leading, bones, rows * columns)
    return blended.reshape(*leading, len(weights), rows, columns)


def transform_points(transforms: NDArray, points: NDArray) -> NDArray:
    """Move each point by its own transform.

    Args:
        transforms: [..., N, R, 4] with R = 3 or 4 rows, metres; a fourth row is ignored.
        points: [..., N, 3], metres.

    Returns:
        [..., N, 3], metres.
    """
    return np.einsum("...nrc,...nc->...nr", transforms[..., :3, :3], points) + transforms[..., :3, 3]
