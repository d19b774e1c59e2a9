"""Rotation matrices and rotation vectors as NumPy arrays, float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["matrix_to_vector", "nearest_rotations", "project_to_rotations", "vector_to_matrix"]

Array = NDArray[np.float64]


def vector_to_matrix(vectors: Array) -> Array:
    """Return rotation matrices [..., 3, 3] of rotation vectors [..., 3], radians."""
    vectors = np.asarray(vectors, np.float64)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def matrix_to_vector(matrices: Array) -> Array:
    """Return rotation vectors [..., 3], radians, at most pi long, of rotation matrices [..., 3, 3]."""
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(matrices.shape[:-1])


def project_to_rotations(matrices: Array) -> Array:
    """Return the rotations closest to matrices [..., 3, 3] that differ from rotations by rounding only."""
    u, _, v = np.linalg.svd(matrices)
    return u @ v


def nearest_rotations(matrices: Array) -> Array:
    """Return the rotations [..., 3, 3] closest to any matrices, none of them a reflection (Kabsch 1976)."""
    u, _, v = np.linalg.svd(matrices)
    u[..., :, 2] *= np.linalg.det(u @ v)[..., None]
    return u @ v
