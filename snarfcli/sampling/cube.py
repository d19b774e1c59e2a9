"""The papers' sampling cube around a posed mesh, and points and vertices quantised in it."""

from __future__ import annotations

import numpy as np

__all__ = ["CUBE_LEVELS", "CUBE_PADDING", "dequantise", "pack_vertices", "quantise", "sampling_cube", "unpack_vertices"]

CUBE_PADDING = 0.1
"""The papers' box is a cube around the mesh whose side is the longest side of the tight box times 1.1."""

CUBE_LEVELS = 65536  # uint16; steps of 30 micrometres in a cube of 2 m
_VERTEX_BITS = 21  # three of them fit a uint64
_VERTEX_LEVELS = 1 << _VERTEX_BITS


def sampling_cube(vertices: np.ndarray, padding: float = CUBE_PADDING) -> tuple[np.ndarray, np.float32]:
    """Return the papers' sampling cube of a posed mesh.

    Args:
        vertices: [V, 3], metres.
        padding: added to the longest side of the tight box, as a share of it.

    Returns:
        The lower corner [3] and the side of the cube, float32, metres.
    """
    lower, upper = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
    size = (upper - lower).max() * (1.0 + padding)
    return ((lower + upper - size) / 2).astype(np.float32), np.float32(size)


def quantise(points: np.ndarray, cube_lower: np.ndarray, cube_size: float | np.floating) -> np.ndarray:
    """Return the uint16 cells of points; a point outside the cube gets the nearest cell of its border.

    Args:
        points: [..., 3], metres.
        cube_lower: [3], metres.
        cube_size: metres.
    """
    cells = np.floor((points - cube_lower) * (CUBE_LEVELS / np.float64(cube_size)))
    return np.clip(cells, 0, CUBE_LEVELS - 1).astype(np.uint16)


def dequantise(cells: np.ndarray, cube_lower: np.ndarray, cube_size: np.ndarray | float | np.floating) -> np.ndarray:
    """Return the float32 centres of uint16 cells. The labels are made for exactly these points, so nothing is lost.

    Args:
        cells: [..., 3] uint16.
        cube_lower: [..., 3] float32, metres, broadcast against `cells`.
        cube_size: [..., 1] or a number, float32, metres.
    """
    step = np.asarray(cube_size, np.float32) / np.float32(CUBE_LEVELS)
    return (cells.astype(np.float32) + np.float32(0.5)) * step + np.asarray(cube_lower, np.float32)


def pack_vertices(vertices: np.ndarray, cube_lower: np.ndarray, cube_size: float | np.floating) -> np.ndarray:
    """Return vertices [V, 3], metres, as one uint64 each [V]: 21 bits per axis, half a micrometre in a cube of 2 m.

    This is finer than the 16 bits of the points, so that no label is wrong beyond 0.01 mm from the surface.
    """
    cells = np.floor((np.asarray(vertices, np.float64) - cube_lower) * (_VERTEX_LEVELS / np.float64(cube_size)))
    x, y, z = np.clip(cells, 0, _VERTEX_LEVELS - 1).astype(np.uint64).T
    return x | y << np.uint64(_VERTEX_BITS) | z << np.uint64(2 * _VERTEX_BITS)


def unpack_vertices(packed: np.ndarray, cube_lower: np.ndarray, cube_size: float | np.floating) -> np.ndarray:
    """Return the vertices [V, 3] float32, metres, that `pack_vertices` packed."""
    shifts = np.array([0, _VERTEX_BITS, 2 * _VERTEX_BITS], np.uint64)
    cells = (packed[:, None] >> shifts) & np.uint64(_VERTEX_LEVELS - 1)
    step = np.float64(cube_size) / _VERTEX_LEVELS
    return ((cells.astype(np.float64) + 0.5) * step + cube_lower).astype(np.float32)
