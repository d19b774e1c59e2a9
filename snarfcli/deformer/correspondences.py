"""The public search: find every canonical correspondence of posed points, with exact implicit gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.deformer.broyden import broyden_roots
from snarfcli.deformer.complete import complete_roots
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, trilinear_weights
from snarfcli.deformer.search import Roots
from snarfcli.deformer.skinning import blend_transforms
from snarfcli.precision import matmul_precision

__all__ = ["Correspondences", "find_correspondences"]


@dataclass(frozen=True)
class Correspondences:
    """Canonical correspondences of B x N posed points, compact: only real roots."""

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

    @property
    def pose(self) -> Tensor:
        """Index b of each root's pose, [M]."""
        return self.query // max(self.count, 1)

    @property
    def found(self) -> Tensor:
        """Which queries have a correspondence, bool [B, N]."""
        mask = torch.zeros(self.batch * self.count, dtype=torch.bool, device=self.query.device)
        mask[self.query] = True
        return mask.reshape(self.batch, self.count)

    def padded(self) -> tuple[Tensor, Tensor]:
        """Return the roots as [B, N, I, 3] and a mask [B, N, I], I the most roots of any query, at least 1."""
        total = self.batch * self.count
        counts = torch.bincount(self.query, minlength=total)
        most = max(int(counts.max()), 1) if total else 1
        slot = torch.arange(len(self.query), device=self.query.device) - (counts.cumsum(0) - counts)[self.query]
        at = self.query * most + slot
        roots = self.canonical.new_zeros(total * most, 3).index_copy(0, at, self.canonical)
        mask = torch.zeros(total * most, dtype=torch.bool, device=at.device)
        mask[at] = True
        return roots.reshape(self.batch, self.count, most, 3), mask.reshape(self.batch, self.count, most)

    def maximum(self, values: Tensor, empty: float) -> Tensor:
        """Return the largest of `values` [M] over each query's correspondences, [B, N]; `empty` where there is none.

        Source: SNARF Eq. 9.
        """
        out = values.new_full((self.batch * self.count,), empty)
        return out.scatter_reduce(0, self.query, values, "amax").reshape(self.batch, self.count)


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

    Returns:
        The correspondences, differentiable in `points`, `bone_transforms` and `skinning_weights` by implicit
        differentiation at the roots; no gradient passes the iterations. A second derivative is refused.

    Raises:
        ValueError: a shape, name or index does not fit; the message names the argument, what was wanted and what came.
        TypeError: a dtype is not float32 or float64, or the dtypes differ.

    Source: SNARF Sec. 3.2 and 3.4 (Eq. 5-9, 14); Fast-SNARF Sec. 4.
    """
    _check(points, bone_transforms, skinning_weights, search, init_bones, active_cells, jacobian)
    grid = grid.to(points)
    depth, height, width = skinning_weights.shape[:3]
    shape = (depth, height, width)
    length = grid.longest_side
    with matmul_precision("highest"):
        transforms = blend_transforms(skinning_weights, bone_transforms)
    with torch.no_grad(), matmul_precision("highest"):
        if search == "complete":
            roots = complete_roots(
                points.detach(),
                transforms.detach(),
                grid,
                shape,
                active_cells=active_cells,
                tolerance=tolerance * length,
                max_steps=max_steps,
            )
        else:
            roots = broyden_roots(
                points.detach(),
                transforms.detach(),
                bone_transforms.detach(),
                grid,
                shape,
                init_bones=init_bones,
                jacobian=jacobian,
                tolerance=tolerance * length,
                divergence=divergence * length,
                max_steps=max_steps,
            )
    canonical = _attach_gradient(points, transforms, roots, shape)
    return Correspondences(canonical, roots.query, roots.jacobian_inverse, points.shape[0], points.shape[1])


def _attach_gradient(points: Tensor, transforms: Tensor, roots: Roots, shape: tuple[int, int, int]) -> Tensor:
    """Return the roots' canonical points [M, 3] with the implicit gradient to `points` and `transforms`."""
    if not (torch.is_grad_enabled() and (points.requires_grad or transforms.requires_grad)):
        return roots.canonical
    pose = roots.query // max(points.shape[1], 1)
    nodes = cell_corners(roots.cell, shape) + (pose * transforms.shape[1])[:, None]
    return _ImplicitRoots.apply(points, transforms, roots.canonical, roots.jacobian_inverse, roots.query, nodes, roots.local)


class _ImplicitRoots(torch.autograd.Function):
    """Derivative of the roots of T(x) [x; 1] = x' by the queries x' and the blended node transforms T_v.

    With g the gradient of the loss by x*, implicit differentiation (SNARF Eq. 14) gives J^-T g for the query, and
    -J^-T g outer [x*; 1], weighted trilinearly, for each of the eight nodes of the root's cell.
    """

    @staticmethod
    def forward(ctx, points, transforms, canonical, jacobian_inverse, query, nodes, local):
        ctx.save_for_backward(canonical, jacobian_inverse, query, nodes, local)
        ctx.shapes = points.shape, transforms.shape
        return canonical.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        canonical, jacobian_inverse, query, nodes, local = ctx.saved_tensors
        points_shape, transforms_shape = ctx.shapes
        with matmul_precision("highest"):
            pulled = torch.bmm(jacobian_inverse.transpose(1, 2), gradient[:, :, None])
        v_points = v_transforms = None
        if ctx.needs_input_grad[0]:
            v_points = gradient.new_zeros(points_shape[0] * points_shape[1], 3)
            v_points = v_points.index_add(0, query, pulled[:, :, 0]).reshape(points_shape)
        if ctx.needs_input_grad[1]:
            homogeneous = torch.cat([canonical, torch.ones_like(canonical[:, :1])], 1)
            v_blended = -(pulled * homogeneous[:, None]).reshape(-1, 12)
            v_corners = trilinear_weights(local)[..., None] * v_blended[:, None]
            v_transforms = gradient.new_zeros(transforms_shape[0] * transforms_shape[1], 12)
            v_transforms = v_transforms.index_add(0, nodes.reshape(-1), v_corners.reshape(-1, 12)).reshape(transforms_shape)
        return v_points, v_transforms, None, None, None, None, None


def _check(points, bone_transforms, skinning_weights, search, init_bones, active_cells, jacobian) -> None:
    """Refuse arguments that do not fit together."""
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points must have shape [B, N, 3], got {list(points.shape)}")
    if skinning_weights.ndim != 4 or min(skinning_weights.shape[:3]) < 2:
        raise ValueError(f"skinning_weights must be [D, H, W, J], two nodes or more a side, got {list(skinning_weights.shape)}")
    bones = skinning_weights.shape[3]
    wanted = [points.shape[0], bones, 4, 4]
    if list(bone_transforms.shape) != wanted:
        raise ValueError(f"bone_transforms must have shape {wanted} to fit the others, got {list(bone_transforms.shape)}")
    for name, tensor in (("points", points), ("bone_transforms", bone_transforms), ("skinning_weights", skinning_weights)):
        if tensor.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name} must be float32 or float64, got {tensor.dtype}")
        if tensor.dtype != points.dtype:
            raise TypeError(f"{name} must have the dtype of points, {points.dtype}, got {tensor.dtype}")
        if tensor.device != points.device:
            raise ValueError(f"{name} must be on the device of points, {points.device}, got {tensor.device}")
    if search not in ("complete", "broyden"):
        raise ValueError(f"search must be 'complete' or 'broyden', got {search!r}")
    if jacobian not in ("exact", "broyden"):
        raise ValueError(f"jacobian must be 'exact' or 'broyden', got {jacobian!r}")
    if search == "complete" and jacobian == "broyden":
        raise ValueError("jacobian='broyden' needs search='broyden': a complete search has the exact one at hand")
    if init_bones is not None and not all(0 <= bone < bones for bone in init_bones):
        raise ValueError(f"init_bones must lie in 0..{bones - 1}, got {list(init_bones)}")
    if init_bones is not None and not len(init_bones):
        raise ValueError("init_bones must name at least one bone, got none; None means all bones")
    cells = [n - 1 for n in skinning_weights.shape[:3]]
    if active_cells is not None and (list(active_cells.shape) != cells or active_cells.dtype != torch.bool):
        raise ValueError(f"active_cells must be bool {cells}, got {active_cells.dtype} {list(active_cells.shape)}")
