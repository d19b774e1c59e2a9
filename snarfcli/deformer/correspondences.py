"""The public search: find every canonical correspondence of posed points, with exact implicit gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.deformer.cells import corners_of
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.ops import broyden_search, complete_search
from snarfcli.deformer.roots import invert_3x3
from snarfcli.deformer.skinning import blend_transforms

__all__ = ["Correspondences", "check_transforms", "find_correspondences"]


@dataclass(frozen=True)
class Correspondences:
    """Canonical correspondences of B x N posed points, compact: only real roots.

    Where a capacity was given, rows beyond the roots belong to no query; they hold zeros and the query B * N.
    """

    canonical: Tensor
    """[M, 3], metres; differentiable in the points, the skinning weights and the bone transforms."""
    query: Tensor
    """Flat index b * N + n of each root's query, [M], ascending."""
    jacobian_inverse: Tensor
    """Inverse of dd/dx at each root, [M, 3, 3]; carries no gradient."""
    batch: int
    """B."""
    count: int
    """N."""
    total: Tensor
    """Number of roots found, [1]; more than M only where a capacity cut them."""

    @property
    def pose(self) -> Tensor:
        """Index b of each root's pose, [M]."""
        return (self.query // max(self.count, 1)).clamp_max(max(self.batch - 1, 0))

    @property
    def found(self) -> Tensor:
        """Which queries have a correspondence, bool [B, N]."""
        mask = torch.zeros(self.batch * self.count + 1, dtype=torch.bool, device=self.query.device)
        mask[self.query] = True
        return mask[:-1].reshape(self.batch, self.count)

    @property
    def counts(self) -> Tensor:
        """How many correspondences each query has, [B, N]."""
        counts = self.query.new_zeros(self.batch * self.count + 1)
        return counts.index_add(0, self.query, torch.ones_like(self.query))[:-1].reshape(self.batch, self.count)

    def padded(self) -> tuple[Tensor, Tensor]:
        """Return the roots as [B, N, I, 3] and a mask [B, N, I], I the most roots of any query, at least 1."""
        total = self.batch * self.count
        real = (self.query < total).nonzero()[:, 0]
        query = self.query[real]
        counts = torch.bincount(query, minlength=total)
        most = max(int(counts.max()), 1) if total else 1
        slot = torch.arange(len(query), device=query.device) - (counts.cumsum(0) - counts)[query]
        at = query * most + slot
        roots = self.canonical.new_zeros(total * most, 3).index_copy(0, at, self.canonical[real])
        mask = torch.zeros(total * most, dtype=torch.bool, device=at.device)
        mask[at] = True
        return roots.reshape(self.batch, self.count, most, 3), mask.reshape(self.batch, self.count, most)

    def maximum(self, values: Tensor, empty: float) -> Tensor:
        """Return the largest of `values` [M] over each query's correspondences, [B, N]; `empty` where there is none.

        Source: SNARF Eq. 9.
        """
        out = values.new_full((self.batch * self.count + 1,), empty)
        return out.scatter_reduce(0, self.query, values, "amax", include_self=False)[:-1].reshape(self.batch, self.count)


def find_correspondences(
    points: Tensor,
    bone_transforms: Tensor,
    skinning_weights: Tensor,
    grid: CanonicalGrid,
    *,
    search: str = "complete",
    init_bones: Sequence[int] | None = None,
    active_cells: Tensor | None = None,
    tolerance: float = 5e-6,
    max_steps: int = 10,
    divergence: float = 0.25,
    jacobian: str = "exact",
    orientation_preserving: bool = False,
    backend: str = "auto",
    capacity: int | None = None,
    check: bool = True,
) -> Correspondences:
    """Find the canonical points that forward skinning moves onto the given posed points.

    Args:
        points: queries [B, N, 3], posed space, metres. A non-finite point has no correspondence.
        bone_transforms: [B, J, 4, 4], canonical to posed, metres; invertible.
        skinning_weights: [D, H, W, J] at the grid nodes (z, y, x), rows sum to 1.
        grid: the box of the nodes.
        search: "complete" (cell by cell, without start bones) or "broyden" (the papers': one start per bone).
        init_bones: bones that start a broyden search; None for all.
        active_cells: bool [D-1, H-1, W-1], the cells that a complete search looks into; None for all.
        tolerance: largest residual of a root, as a share of the grid's longest side.
        max_steps: most steps for one start.
        divergence: residual at which a broyden start is given up, as a share of the grid's longest side.
        jacobian: "exact", or "broyden" for the approximate inverse of a broyden search (Fast-SNARF Eq. 15).
        orientation_preserving: leave out roots where the Jacobian's determinant is negative: there the body is inside out.
        backend: "native" (the compiled CPU library, CUDA kernels on a GPU), "reference" (PyTorch), or "auto" for native where
            it is there; a warning says once why it is not.
        capacity: most roots to return. The results then have this length whatever is found, so that a GPU need not be waited
            for and the call can be captured in a CUDA graph; rows beyond the roots have the query B * N. torch.compile with
            fullgraph=True needs it too, or torch._dynamo.config.capture_dynamic_output_shape_ops.
        check: whether to look at the values of transforms and weights; on a GPU they are never looked at.

    Returns:
        The correspondences, differentiable in `points`, `bone_transforms` and `skinning_weights` by implicit
        differentiation at the roots; no gradient passes the iterations. A second derivative is refused.

    Raises:
        ValueError: a shape, name or index does not fit, a transform is not finite or singular, or weights do not sum to 1; the
            message names the argument, what was wanted and what came.
        TypeError: a dtype is not float32 or float64, or the dtypes differ.

    Source: SNARF Sec. 3.2 and 3.4 (Eq. 5-9, 14); Fast-SNARF Sec. 4.
    """
    _check_shapes(points, bone_transforms, skinning_weights, active_cells)
    _check_settings(search, init_bones, active_cells, jacobian, backend, bone_transforms.shape[1])
    for name, value in (("tolerance", tolerance), ("max_steps", max_steps), ("divergence", divergence)):
        if not value > 0:
            raise ValueError(f"{name} must be greater than 0, got {value}")
    if capacity is not None and capacity < 0:
        raise ValueError(f"capacity must be 0 or more, got {capacity}")
    grid = grid.to(points)
    if check:
        _check_values(grid, bone_transforms, skinning_weights, active_cells)
    depth, height, width = skinning_weights.shape[:3]
    transforms = blend_transforms(skinning_weights, bone_transforms, active_cells, backend)
    box = (grid.lower, grid.upper, [depth, height, width])
    common = (orientation_preserving, capacity, backend)
    if search == "complete":
        found = complete_search(points, transforms, *box, active_cells, tolerance, max_steps, *common)
    else:
        starts = _start_transforms(bone_transforms.detach(), init_bones)
        found = broyden_search(points, transforms, starts, *box, tolerance, divergence, max_steps, jacobian == "exact", *common)
    canonical, query, jacobian_inverse, total = found
    return Correspondences(canonical, query, jacobian_inverse.detach(), points.shape[0], points.shape[1], total)


def _start_transforms(bone_transforms: Tensor, init_bones: Sequence[int] | None) -> Tensor:
    """Return the upper rows of the inverse transforms of the start bones, [B, I, 12], posed to canonical."""
    chosen = bone_transforms if init_bones is None else bone_transforms[:, list(init_bones)]
    turn, _ = invert_3x3(chosen[..., :3, :3].reshape(-1, 3, 3))
    shift = -(turn * chosen[..., :3, 3].reshape(-1, 1, 3)).sum(-1)
    return torch.cat([turn, shift[..., None]], -1).reshape(*chosen.shape[:2], 12)


@torch.no_grad()
def check_transforms(bone_transforms: Tensor) -> None:
    """Refuse transforms [B, J, 4, 4] that cannot be inverted; on a GPU, which would be waited for, nothing is looked at.

    Raises:
        ValueError: one is not finite or singular.
    """
    if bone_transforms.is_cuda or torch.compiler.is_compiling():
        return
    if not bool(bone_transforms.isfinite().all()):
        raise ValueError("bone_transforms must be finite, got NaN or infinite values")
    turn = bone_transforms[..., :3, :3].reshape(-1, 3, 3)
    _, determinant = invert_3x3(turn)
    singular = (determinant.abs() <= 1e-9 * turn.abs().amax((1, 2)) ** 3).nonzero()[:, 0]
    if len(singular):
        pose, bone = divmod(int(singular[0]), bone_transforms.shape[1])
        raise ValueError(f"bone_transforms must be invertible, got a singular one for bone {bone} of pose {pose}")


def _check_values(grid: CanonicalGrid, bone_transforms: Tensor, skinning_weights: Tensor, active_cells: Tensor | None) -> None:
    """Refuse a box, transforms or weights that are none; on a GPU, which would be waited for, nothing is looked at."""
    if bone_transforms.is_cuda or torch.compiler.is_compiling():
        return
    if not bool((grid.upper > grid.lower).all()):
        box = f"{grid.lower.tolist()} and {grid.upper.tolist()}"
        raise ValueError(f"grid.upper must exceed grid.lower in {grid.lower.dtype}, got {box}")
    check_transforms(bone_transforms)
    with torch.no_grad():
        wrong = ~((skinning_weights.sum(-1) - 1).abs() < 1e-3)
        if active_cells is not None:
            wrong &= corners_of(active_cells)
        if bool(wrong.any()):
            came = float(skinning_weights[wrong][0].sum())
            raise ValueError(f"skinning_weights must sum to 1 at every node of a searched cell, got a sum of {came:.4g}")


def _check_shapes(points: Tensor, bone_transforms: Tensor, skinning_weights: Tensor, active_cells: Tensor | None) -> None:
    """Refuse tensors that do not fit together."""
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points must have shape [B, N, 3], got {list(points.shape)}")
    if skinning_weights.ndim != 4 or min(skinning_weights.shape[:3]) < 2 or skinning_weights.shape[3] < 1:
        raise ValueError(f"skinning_weights must be [D, H, W, J], two nodes or more a side, got {list(skinning_weights.shape)}")
    wanted = [points.shape[0], skinning_weights.shape[3], 4, 4]
    if list(bone_transforms.shape) != wanted:
        raise ValueError(f"bone_transforms must have shape {wanted} to fit the others, got {list(bone_transforms.shape)}")
    for name, tensor in (("points", points), ("bone_transforms", bone_transforms), ("skinning_weights", skinning_weights)):
        if tensor.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name} must be float32 or float64, got {tensor.dtype}")
        if tensor.dtype != points.dtype:
            raise TypeError(f"{name} must have the dtype of points, {points.dtype}, got {tensor.dtype}")
        if tensor.device != points.device:
            raise ValueError(f"{name} must be on the device of points, {points.device}, got {tensor.device}")
    if active_cells is None:
        return
    cells = [n - 1 for n in skinning_weights.shape[:3]]
    if list(active_cells.shape) != cells or active_cells.dtype != torch.bool:
        raise ValueError(f"active_cells must be bool {cells}, got {active_cells.dtype} {list(active_cells.shape)}")
    if active_cells.device != points.device:
        raise ValueError(f"active_cells must be on the device of points, {points.device}, got {active_cells.device}")


def _check_settings(
    search: str, init_bones: Sequence[int] | None, active_cells: Tensor | None, jacobian: str, backend: str, bones: int
) -> None:
    """Refuse names and settings that mean nothing, or nothing to this search."""
    choices = {
        "search": (search, ("complete", "broyden")),
        "jacobian": (jacobian, ("exact", "broyden")),
        "backend": (backend, ("auto", "native", "reference")),
    }
    for name, (value, known) in choices.items():
        if value not in known:
            raise ValueError(f"{name} must be {', '.join(map(repr, known[:-1]))} or {known[-1]!r}, got {value!r}")
    if search == "complete" and jacobian == "broyden":
        raise ValueError("jacobian='broyden' needs search='broyden': a complete search has the exact one at hand")
    if search == "complete" and init_bones is not None:
        raise ValueError("init_bones needs search='broyden': a complete search has no starts")
    if search == "broyden" and active_cells is not None:
        raise ValueError("active_cells needs search='complete': broyden goes wherever its steps lead")
    if init_bones is not None and not all(0 <= bone < bones for bone in init_bones):
        raise ValueError(f"init_bones must lie in 0..{bones - 1}, got {list(init_bones)}")
    if init_bones is not None and not len(init_bones):
        raise ValueError("init_bones must name at least one bone, got none; None means all bones")
