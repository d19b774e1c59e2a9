"""Linear blend skinning, pointwise and blended once per grid node."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.blending import blend
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.networks import MAX_FEATURES, run_encoding
from snarfcli.precision import matmul_precision

__all__ = ["blend_transforms", "forward_jacobian", "interpolate", "skin"]


_INSIDE = 5e-5  # share of a cell; float32 places points in a grid of 64 cells to 2e-5


def skin(canonical: Tensor, weights: Tensor, bone_transforms: Tensor) -> Tensor:
    """Move canonical points into the posed frame by linear blend skinning.

    Args:
        canonical: [N, 3], points, canonical frame, metres.
        weights: [N, J], skinning weights, non-negative, rows sum to 1.
        bone_transforms: [J, 4, 4], canonical to posed, metres.

    Returns:
        Posed points, [N, 3], metres.

    Source: SNARF Eq. 4.
    """
    with matmul_precision("highest"), torch.autocast(canonical.device.type, enabled=False):
        blended = (weights @ bone_transforms[:, :3].reshape(len(bone_transforms), 12)).reshape(-1, 3, 4)
        return (blended[:, :, :3] @ canonical[:, :, None])[:, :, 0] + blended[:, :, 3]


def blend_transforms(
    skinning_weights: Tensor, bone_transforms: Tensor, active_cells: Tensor | None = None, backend: str = "auto"
) -> Tensor:
    """Blend the bone transforms once per grid node and pose.

    Args:
        skinning_weights: [D, H, W, J] at the grid nodes, or [B, D, H, W, J], those of each pose.
        bone_transforms: [B, J, 4, 4], canonical to posed.
        active_cells: [D-1, H-1, W-1], bool; other nodes than their corners may get zeros. None for all.
        backend: "auto", "native" or "reference".

    Returns:
        The upper three rows of the blended transforms, flattened: [B, D * H * W, 12].

    Source: Fast-SNARF Eq. 13.
    """
    bones = bone_transforms[:, :, :3].reshape(*bone_transforms.shape[:2], 12)
    if skinning_weights.ndim == 4:
        return blend(skinning_weights, bones, active_cells, backend)
    if not len(bones):
        return blend(skinning_weights.sum(0), bones, active_cells, backend)  # nothing, of the right shape
    poses = zip(skinning_weights, bones.split(1), strict=True)
    return torch.cat([blend(weights, pose, active_cells, backend) for weights, pose in poses])


def interpolate(values: Tensor, points: Tensor, grid: CanonicalGrid) -> Tensor:
    """Interpolate node values [D, H, W, C] at canonical points [N, 3]; points outside get the values of the border.

    Returns:
        [N, C].
    """
    shape = values.shape[:3]
    if not torch.is_grad_enabled() and points.device.type == "cpu" and points.dtype == values.dtype == torch.float32:
        depth, height, width = shape
        size = grid.cell_size(shape)
        # a little inside of the border, where rounding could put a point outside, which has no values there
        inside = points.clamp(grid.lower + _INSIDE * size, grid.upper - _INSIDE * size)
        rows = torch.arange(depth * height * width, dtype=torch.int32)
        box = [*grid.lower.tolist(), *size.tolist()]
        none = points.new_empty(0)
        tables = values.reshape(-1, values.shape[-1]).split(MAX_FEATURES, dim=1)
        parts = [run_encoding(inside, none, table, rows, [width, height, depth], box)[:, 3:] for table in tables]
        return parts[0] if len(parts) == 1 else torch.cat(parts, 1)
    cell, local = locate(points, grid, shape)
    corners = cell_corners(cell, shape)
    phi = trilinear_weights(local.clamp(0, 1))
    return (phi[..., None] * values.reshape(-1, values.shape[-1])[corners]).sum(-2)


def forward_jacobian(corner_transforms: Tensor, local: Tensor, origin: Tensor, cell_size: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluate d(x) = T(x) [x; 1] and its exact Jacobian inside grid cells.

    Args:
        corner_transforms: [M, 8, 12], blended transforms at the corners of each point's cell.
        local: [M, 3], coordinates in the cell, 0 to 1 inside.
        origin: [M, 3], canonical position of the cell's first corner, metres.
        cell_size: [3], metres.

    Returns:
        Posed points [M, 3], metres, and the derivatives [M, 3, 3] of the posed point by the *cell coordinates*
        (divide column i by cell_size[i] for the derivative by the canonical point).

    Source: SNARF Eq. 4 with T(x) trilinear (Fast-SNARF Sec. 4.1); product rule for the Jacobian.
    """
    # Interpolate along z, then y, then x, and carry the differences along: several times faster than products with
    # the trilinear weights and their derivatives.
    u, v, w = (coordinate[:, None, None] for coordinate in local.unbind(1))
    by_w = corner_transforms[:, 4:] - corner_transforms[:, :4]
    at_w = torch.addcmul(corner_transforms[:, :4], by_w, w)
    by_v = at_w[:, 2:] - at_w[:, :2]
    at_v = torch.addcmul(at_w[:, :2], by_v, v)
    by_w = torch.lerp(by_w[:, :2], by_w[:, 2:], v)
    by_u = at_v[:, 1] - at_v[:, 0]
    u = u[:, 0]
    blended = torch.addcmul(at_v[:, 0], by_u, u)
    by_v, by_w = torch.lerp(by_v[:, 0], by_v[:, 1], u), torch.lerp(by_w[:, 0], by_w[:, 1], u)
    canonical = torch.addcmul(origin, local, cell_size)
    homogeneous = torch.cat([canonical, torch.ones_like(canonical[:, :1])], 1)
    stacked = torch.stack([blended, by_u, by_v, by_w], 1).reshape(-1, 12, 4)
    moved = torch.bmm(stacked, homogeneous[:, :, None]).reshape(-1, 4, 3)  # T x, then dT/du_i x
    jacobian = moved[:, 1:].transpose(1, 2) + blended.reshape(-1, 3, 4)[:, :, :3] * cell_size
    return moved[:, 0], jacobian
