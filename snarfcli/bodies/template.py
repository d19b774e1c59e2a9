"""A subject's mesh in the canonical pose with the skinning weights that its posed meshes were made with."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

__all__ = ["MeshTemplate"]


@dataclass(frozen=True, eq=False)
class MeshTemplate:
    """Ground truth for evaluation, for pictures, and for the systems that use ground-truth skinning weights."""

    vertices: NDArray
    """[V, 3], canonical frame, metres."""
    faces: NDArray
    """[F, 3], vertex numbers, outward; [0, 3] where only the vertices are known."""
    weights: NDArray
    """[V, J], skinning weights, rows sum to 1."""
