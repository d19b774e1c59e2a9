"""The correspondence searches that the benchmark compares, behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from released_search import released_search
from scenes import Scene
from torch import Tensor

from snarfcli.deformer import SearchConfig, find_correspondences
from snarfcli.native.library import native_library

__all__ = ["Found", "Method", "as_found", "methods"]

_BROYDEN_M = {"tolerance": 1e-4, "divergence": 0.5}  # the released thresholds, metres


@dataclass(frozen=True)
class Method:
    """A search to compare."""

    name: str
    run: Callable
    """`run(points [B, N, 3], bone_transforms [B, J, 4, 4], scene, active cells or None)`."""
    uses_cells: bool = False
    """Whether it searches only the active cells; other searches ignore them."""
    has_gradient: bool = True
    """Whether the result is differentiable."""
    timed: bool = True
    """Whether it is part of the timings."""


@dataclass
class Found:
    """Result of a search for N queries of one pose."""

    canonical: np.ndarray
    """[M, 3], metres."""
    query: np.ndarray
    """[M]."""
    jacobian_inverse: np.ndarray
    """[M, 3, 3]."""


def methods(names: str | None = None) -> list[Method]:
    """Return the searches that can run here, those of this package first; `names` (a, b, c) selects by parts of their names."""
    native = ["native"] if native_library() is not None else []
    found = [Method(f"complete, {backend}", _ours(backend), True) for backend in [*native, "reference"]]
    found += [Method(f"complete, {backend}, float64", _in_float64(_ours(backend)), True, timed=False) for backend in native]
    for backend in native or ["reference"]:
        found.append(Method(f"broyden, 9 start bones, {backend}", _ours(backend, "broyden", nine=True)))
        found.append(Method(f"broyden, all bones, {backend}", _ours(backend, "broyden")))
    found.append(Method("Fast-SNARF as released, 9 start bones, PyTorch", _released, has_gradient=False))
    return found if names is None else [m for m in found if any(name in m.name for name in names.split(","))]


def _ours(backend: str, search: str = "complete", nine: bool = False) -> Callable:
    def run(points: Tensor, transforms: Tensor, scene: Scene, active: Tensor | None = None):
        settings = SearchConfig(search, backend=backend)
        if search == "broyden":
            limits = {name: value / scene.grid.longest_side for name, value in _BROYDEN_M.items()}
            settings = replace(settings, init_bones=list(scene.init_bones) if nine else None, **limits)
        cells = active if search == "complete" else None
        return find_correspondences(points, transforms, scene.weights, scene.grid, search=settings, active_cells=cells)

    return run


def _in_float64(search: Callable) -> Callable:
    def run(points: Tensor, transforms: Tensor, scene: Scene, active: Tensor | None = None):
        return search(points.double(), transforms.double(), replace(scene, weights=scene.weights.double()), active)

    return run


def _released(points: Tensor, transforms: Tensor, scene: Scene, active: Tensor | None = None):
    return released_search(points, transforms, scene.weights, scene.grid, scene.init_bones)


def as_found(result) -> Found:
    """Return the arrays of a search's result."""
    fields = result if isinstance(result, tuple) else (result.canonical, result.query, result.jacobian_inverse)
    return Found(*(field.detach().numpy() for field in fields))
