"""Settings of the correspondence search."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BACKENDS", "JACOBIANS", "SEARCHES", "SearchConfig"]

SEARCHES = ("complete", "broyden")
"""Names of the searches."""
JACOBIANS = ("exact", "broyden")
"""Inverse Jacobians at the roots of a broyden search."""
BACKENDS = ("auto", "native", "reference")
"""What computes."""


@dataclass
class SearchConfig:
    name: str = "complete"
    """Which search: complete (cell by cell, without start bones) or broyden (the papers')."""
    init_bones: list[int] | None = None
    """Bones whose inverse transforms start a broyden search; null means all bones. An empty list, which is for
    whoever knows the skeleton to fill in, stands for the papers' nine where the joints are SMPL's, else all."""
    jacobian: str = "exact"
    """Inverse Jacobian at broyden's roots: exact, or broyden for the approximation of the papers."""
    tolerance: float = 5e-6
    """Largest residual of a root, as a share of the longest side of the canonical grid."""
    max_steps: int = 10
    """Most steps of Newton's or Broyden's method for one start."""
    divergence: float = 0.25
    """Residual at which a broyden start is given up, as a share of the longest side of the canonical grid."""
    orientation_preserving: bool = False
    """Whether roots are left out where the body is turned inside out (negative determinant of the Jacobian)."""
    backend: str = "auto"
    """What computes: native (compiled library or CUDA kernels), reference (PyTorch), or auto: native where it is there."""
