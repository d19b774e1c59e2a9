"""Triangle meshes with vertex attributes, and their connected surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

__all__ = ["ExtractionStats", "Mesh", "face_components", "keep_components", "vertex_normals"]


@dataclass(frozen=True)
class ExtractionStats:
    """Cost and result of an extraction."""

    points: int
    """Number of points at which the field was evaluated."""
    calls: int
    """Number of calls of the field."""
    voxel: float
    """Edge length of a final cell, metres."""
    components: int
    """Number of connected surfaces found."""
    kept: int
    """Number of connected surfaces in the mesh."""
    capped: bool
    """Whether the field is occupied at the border of the box, so that the surface was closed there."""
    seconds: float
    """Wall time."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with optional vertex attributes.

    Fields:
        vertices: [V, 3] float32, metres.
        faces: [F, 3] int32, counter-clockwise seen from outside.
        colors: [V, 3] uint8, sRGB.
        weights: [V, J] float32 skinning weights, rows sum to 1.
        normals: [V, 3] float32, unit length, outward.
        stats: of the extraction of the mesh, if it was extracted.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    weights: np.ndarray | None = None
    normals: np.ndarray | None = None
    stats: ExtractionStats | None = None

    def __post_init__(self) -> None:
        for name, wanted in (("vertices", np.float32), ("faces", np.int32)):
            array = np.ascontiguousarray(getattr(self, name), dtype=wanted)
            if array.ndim != 2 or array.shape[1] != 3:
                raise ValueError(f"{name}: wanted shape [n, 3], got {list(array.shape)}")
            object.__setattr__(self, name, array)
        if len(self.faces) and (self.faces.min() < 0 or self.faces.max() >= len(self.vertices)):
            raise ValueError(f"faces: wanted indices of {len(self.vertices)} vertices, got {self.faces.max()}")
        for name, wanted in (("colors", np.uint8), ("weights", np.float32), ("normals", np.float32)):
            array = getattr(self, name)
            if array is None:
                continue
            array = np.ascontiguousarray(array, dtype=wanted)
            if len(array) != len(self.vertices) or array.ndim != 2 or (name != "weights" and array.shape[1] != 3):
                columns = "J" if name == "weights" else 3
                raise ValueError(f"{name}: wanted shape [{len(self.vertices)}, {columns}], got {list(array.shape)}")
            object.__setattr__(self, name, array)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the box around the vertices, metres."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @property
    def skinning_weights(self) -> np.ndarray:
        """[V, J] float32, the weights of a mesh that must have some.

        Raises:
            ValueError: the mesh has no weights.
        """
        if self.weights is None:
            raise ValueError("weights: wanted a mesh with skinning weights, got one without")
        return self.weights

    @property
    def unit_normals(self) -> np.ndarray:
        """[V, 3] float32, the normals, computed if the mesh has none."""
        return vertex_normals(self.vertices, self.faces) if self.normals is None else self.normals

    def with_normals(self) -> Mesh:
        """Return the mesh with vertex normals, computed if it has none."""
        return self if self.normals is not None else replace(self, normals=self.unit_normals)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the mean of the face normals at each vertex, weighted by area.

    Args:
        vertices: [V, 3].
        faces: [F, 3].

    Returns:
        [V, 3] float32 of unit length; (0, 1, 0) at a vertex without any area around it.
    """
    corners = vertices.astype(np.float64)[faces]
    normals_f = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # bincount is several times as fast as np.add.at
    index = faces.ravel()
    normals = np.stack(
        [np.bincount(index, np.repeat(normals_f[:, axis], 3), minlength=len(vertices)) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-20, normals / np.maximum(length, 1e-20), (0.0, 1.0, 0.0))
    return normals.astype(np.float32)


def face_components(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """Return the number of the connected surface of each face, [F] int; the largest surface is 0."""
    if not len(faces):
        return np.zeros(0, dtype=np.int64)
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    graph = coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(num_vertices, num_vertices))
    labels = connected_components(graph, directed=False)[1][faces[:, 0]]
    _, labels, counts = np.unique(labels, return_inverse=True, return_counts=True)
    rank = np.empty(len(counts), dtype=np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    return rank[labels.ravel()]


def keep_components(vertices: np.ndarray, faces: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Drop the connected surfaces with fewer faces than `share` of the largest one.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        share: 0 keeps all surfaces, 1 only the largest.

    Returns:
        The remaining vertices and faces, the number of surfaces found, and the number kept.
    """
    labels = face_components(faces, len(vertices))
    counts = np.bincount(labels)
    keep = counts >= share * counts.max(initial=0)
    if keep.all():
        return vertices, faces, len(counts), len(counts)
    faces = faces[keep[labels]]
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces], len(counts), int(keep.sum())
