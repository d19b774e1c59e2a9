"""A subject's mesh in the canonical pose with the skinning weights that its posed meshes were made with."""

from __future__ import annotations

from dataclasses import dataclass

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
