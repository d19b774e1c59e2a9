"""Triangle meshes with vertex attributes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

__all__ = ["ExtractionStats", "Mesh", "normals_at_vertices", "vertex_normals"]


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
    vertices, faces = (np.require(array, requirements=["C", "W"]) for array in (vertices, faces))  # as from_numpy wants it
    return normals_at_vertices(torch.from_numpy(vertices), torch.from_numpy(faces).long()).numpy()


def normals_at_vertices(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return `vertex_normals` of tensors [V, 3] and [F, 3] int64, on their device."""
    places, corners = vertices.double(), faces.unbind(1)
    first, second, third = (places.index_select(0, corner) for corner in corners)
    normals_f = torch.linalg.cross(second - first, third - first)
    index, none = faces.reshape(-1), places.new_zeros(len(vertices))
    # sums of one column after the other are several times as fast as of rows
    sums = [none.index_add(0, index, column.repeat_interleave(3)) for column in normals_f.unbind(1)]
    normals = torch.stack(sums, dim=1)
    length = torch.linalg.vector_norm(normals, dim=1, keepdim=True)
    upward = torch.arange(3, device=faces.device) == 1
    return torch.where(length > 1e-20, normals / length.clamp_min(1e-20), upward.double()).float()
