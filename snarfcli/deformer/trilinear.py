"""Values and transforms that are trilinear between the grid nodes, with their derivatives."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.native import cuda_interpolation
from snarfcli.native.backend import choose_backend
from snarfcli.networks import MAX_FEATURES, run_encoding

__all__ = ["between_corners", "forward_jacobian", "interpolate", "interpolate_nodes", "trilinear_transforms"]

_INSIDE = 5e-5  # share of a cell; float32 places points in a grid of 64 cells to 2e-5


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
    if not torch.is_grad_enabled() and points.device.type == "cuda" and _has_kernel(values, points, grid.lower, grid.upper):
        return interpolate_nodes(values, points, grid.lower, grid.upper)
    return _interpolate_reference(values, points, grid)


def _interpolate_reference(values: Tensor, points: Tensor, grid: CanonicalGrid) -> Tensor:
    shape = values.shape[:3]
    cell, local = locate(points, grid, shape)
    corners = cell_corners(cell, shape)
    phi = trilinear_weights(local.clamp(0, 1))
    return (phi[..., None] * values.reshape(-1, values.shape[-1])[corners]).sum(-2)


@torch.library.custom_op("snarf::interpolate_nodes", mutates_args=())
def interpolate_nodes(values: Tensor, points: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Interpolate as `interpolate` does, in the box with the corners `lower` and `upper` [3]; without gradients."""
    return _interpolate_reference(values, points, CanonicalGrid(lower, upper, checked=True))


@interpolate_nodes.register_kernel("cuda")
def _(values, points, lower, upper):
    if _has_kernel(values, points, lower, upper):
        return cuda_interpolation.interpolate(values, points, lower, upper)
    return _interpolate_reference(values, points, CanonicalGrid(lower, upper, checked=True))


@interpolate_nodes.register_fake
def _(values, points, lower, upper):
    return values.new_empty(len(points), values.shape[3])


def _has_kernel(values: Tensor, *others: Tensor) -> bool:
    """Return whether there is a CUDA kernel for numbers of these types."""
    is_one_type = all(values.dtype == other.dtype for other in others) and values.dtype in (torch.float32, torch.float64)
    return is_one_type and choose_backend("auto", values.device) == "native"


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
    stacked = torch.stack(trilinear_transforms(corner_transforms, local), 1).reshape(-1, 12, 4)
    canonical = torch.addcmul(origin, local, cell_size)
    homogeneous = torch.cat([canonical, torch.ones_like(canonical[:, :1])], 1)
    moved = torch.bmm(stacked, homogeneous[:, :, None]).reshape(-1, 4, 3)  # T x, then dT/du_i x
    jacobian = moved[:, 1:].transpose(1, 2) + stacked[:, :3, :3] * cell_size
    return moved[:, 0], jacobian


def between_corners(values: Tensor, local: Tensor) -> Tensor:
    """Interpolate values [M, 8, C] at the corners of grid cells, at cell coordinates [M, 3]; returns [M, C]."""
    u, v, w = (coordinate[:, None] for coordinate in local.unbind(1))
    at_w = torch.lerp(values[:, :4], values[:, 4:], w[..., None])
    at_v = torch.lerp(at_w[:, :2], at_w[:, 2:], v[..., None])
    return torch.lerp(at_v[:, 0], at_v[:, 1], u)


def trilinear_transforms(corner_transforms: Tensor, local: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Interpolate the transforms at the corners of grid cells.

    Args:
        corner_transforms: [M, 8, C], blended transforms at the corners of each point's cell.
        local: [M, 3], coordinates in the cell, 0 to 1 inside.

    Returns:
        The transforms [M, C], and their derivatives by the three cell coordinates, [M, C] each.
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
    return blended, by_u, by_v, by_w
