"""Settings of the correspondence search, and the one check of them."""

from __future__ import annotations

from dataclasses import dataclass

from snarfcli.field_docs import documented
from snarfcli.native.backend import BACKENDS

__all__ = ["BACKENDS", "JACOBIANS", "SEARCHES", "SearchConfig", "as_search_config", "check_search_config"]

SEARCHES = ("complete", "broyden")
"""Names of the searches."""
_MOST_STEPS = 10_000  # the papers take at most 50
JACOBIANS = ("exact", "broyden")
"""Inverse Jacobians at the roots of a broyden search."""


@documented
@dataclass
class SearchConfig:
    """Settings of a correspondence search."""

    name: str = "complete"
    """Which search: complete (cell by cell, without start bones) or broyden (the papers')."""
    init_bones: list[int] | None = None
    """Bones whose inverse transforms start a broyden search; null means all bones. In a configuration file an empty list stands
    for the papers' nine bones if the joints are SMPL's, and for all bones otherwise."""
    jacobian: str = "exact"
    """Inverse Jacobian at the roots of a broyden search: exact, or broyden for the papers' approximation
    (Fast-SNARF Eq. 15)."""
    tolerance: float = 5e-6
    """Largest residual of a root, as a share of the longest side of the canonical grid."""
    max_steps: int = 10
    """Maximum number of steps of Newton's or Broyden's method from one start."""
    divergence: float = 0.25
    """Residual after a step at which a broyden start is given up, as a share of the longest side of the canonical grid."""
    orientation_preserving: bool = False
    """Whether roots are left out where the body is turned inside out (negative determinant of the Jacobian)."""
    backend: str = "auto"
    """What computes: native (compiled library or CUDA kernels), reference (PyTorch), or auto (native where available)."""


def as_search_config(search: SearchConfig | str | None) -> SearchConfig:
    """Return the settings for a `SearchConfig`, for the name of a search, or for None, the default search."""
    if search is None:
        return SearchConfig()
    return SearchConfig(name=search) if isinstance(search, str) else search


def check_search_config(search: SearchConfig, num_bones: int) -> None:
    """Check the settings of a search over `num_bones` bones.

    Raises:
        ValueError: a name is unknown, a number or an index is out of range, or a setting belongs to another search.
    """
    for name, value, known in (
        ("search.name", search.name, SEARCHES),
        ("search.jacobian", search.jacobian, JACOBIANS),
        ("search.backend", search.backend, BACKENDS),
    ):
        if value not in known:
            raise ValueError(f"{name}: wanted {', '.join(known[:-1])} or {known[-1]}, got {value!r}")
    for name in ("tolerance", "max_steps", "divergence"):
        if not getattr(search, name) > 0:
            raise ValueError(f"search.{name}: wanted more than 0, got {getattr(search, name)}")
    if search.max_steps > _MOST_STEPS:
        raise ValueError(f"search.max_steps: wanted at most {_MOST_STEPS}, got {search.max_steps}")
    if search.name == "complete" and search.jacobian == "broyden":
        raise ValueError("search.jacobian 'broyden' needs search.name 'broyden': a complete search has the exact Jacobian")
    bones = search.init_bones
    if bones is None:
        return
    if search.name == "complete":
        raise ValueError("search.init_bones needs search.name 'broyden': a complete search has no start bones")
    if not bones:
        raise ValueError("search.init_bones: wanted at least one bone, got none; None starts from all bones")
    if not all(0 <= bone < num_bones for bone in bones):
        raise ValueError(f"search.init_bones: wanted bones from 0 to {num_bones - 1}, got {list(bones)}")
    if len(set(bones)) < len(bones):
        raise ValueError(f"search.init_bones: wanted each bone at most once, got {list(bones)}")
