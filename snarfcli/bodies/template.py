"""A subject's mesh in the canonical pose with the skinning weights that its posed meshes were made with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.field_docs import documented

__all__ = ["MeshTemplate"]


@documented
@dataclass(frozen=True, eq=False)
class MeshTemplate:
    """Ground-truth mesh and skinning weights, for evaluation, for pictures, and for systems that are trained with them."""

    vertices: NDArray
    """[V, 3], canonical frame, metres."""
    faces: NDArray
    """[F, 3], vertex indices, with outward normals; [0, 3] if only the vertices are known."""
    weights: NDArray
    """[V, J], skinning weights; each row sums to 1."""
    is_planar: bool = False
    """Whether the subject is planar: the mesh is a prism along z, and the subject its section at z = 0."""

    def surface_vertices(self) -> NDArray[np.int64]:
        """Return the indices of the vertices on the subject's surface: all, or those on the outline of a planar subject.

        The other vertices of a prism are above and below the inside of the section.
        """
        return np.flatnonzero(self.vertices[:, 2] == 0) if self.is_planar else np.arange(len(self.vertices))
