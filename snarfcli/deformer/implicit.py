"""The implicit gradient of the roots of a search (SNARF Eq. 14), as a torch.library operator."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.deformer.grid import cell_corners, locate, trilinear_weights
from snarfcli.deformer.operators import grid_of, register_native
from snarfcli.deformer.second_derivatives import raise_for_second_derivative
from snarfcli.native import cpu, cuda
from snarfcli.native.backend import choose_backend

__all__ = ["add_implicit_gradient", "implicit_backward", "implicit_backward_reference"]


@torch.library.custom_op("snarf::implicit_backward", mutates_args=())
def implicit_backward(
    gradient: Tensor,
    canonical: Tensor,
    query: Tensor,
    jacobian_inverse: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    batch: int,
    count: int,
    wants_points: bool,
    wants_transforms: bool,
    backend: str,
) -> tuple[Tensor, Tensor]:
    """Return the gradients of a loss by the queries [B, N, 3] and by the transforms [B, D * H * W, 12]; empty if not wanted.

    Args:
        gradient: [M, 3], of the loss by the roots.
        canonical, query, jacobian_inverse: as the search returned them.

    Source: SNARF Eq. 14.
    """
    choose_backend(backend, gradient.device.type)  # raises for "native", warns for "auto"
    roots = (gradient, canonical, query, jacobian_inverse)
    return implicit_backward_reference(*roots, lower, upper, shape, batch, count, wants_points, wants_transforms)


def implicit_backward_reference(
    gradient: Tensor,
    canonical: Tensor,
    query: Tensor,
    jacobian_inverse: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    batch: int,
    count: int,
    wants_points: bool,
    wants_transforms: bool,
    into: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The readable version of `implicit_backward`; with `into` the gradient by the transforms is added to that tensor.

    With g the gradient by x*, implicit differentiation gives v = J^-T g for the query, and -v outer [x*; 1], weighted
    trilinearly, for each of the eight nodes of the root's cell.
    """
    grid, nodes = grid_of(lower, upper, shape)
    known = (query < batch * count).nonzero()[:, 0]
    gradient, canonical, query = gradient[known], canonical[known], query[known]
    v = (jacobian_inverse[known] * gradient[:, :, None]).sum(1)
    v_points, v_transforms = gradient.new_empty(0), gradient.new_empty(0)
    if wants_points:
        v_points = gradient.new_zeros(batch * count, 3).index_add(0, query, v).reshape(batch, count, 3)
    if wants_transforms:
        per_pose = nodes[0] * nodes[1] * nodes[2]
        cell, local = locate(canonical, grid, nodes)
        at = cell_corners(cell, nodes) + (query // max(count, 1) * per_pose)[:, None]
        homogeneous = torch.cat([canonical, torch.ones_like(canonical[:, :1])], 1)
        v_blended = -(v[:, :, None] * homogeneous[:, None]).reshape(-1, 12)
        v_corners = trilinear_weights(local)[..., None] * v_blended[:, None]
        v_transforms = gradient.new_zeros(batch, per_pose, 12) if into is None else into
        v_transforms.view(-1, 12).index_add_(0, at.reshape(-1), v_corners.reshape(-1, 12))
    return v_points, v_transforms


def add_implicit_gradient(
    into: Tensor | None,
    gradient: Tensor,
    canonical: Tensor,
    query: Tensor,
    jacobian_inverse: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    batch: int,
    count: int,
    wants_points: bool,
    backend: str,
) -> Tensor:
    """Add the gradient of a loss by the transforms to `into` [B, D * H * W, 12], unless that is None.

    Otherwise as `implicit_backward`.

    Returns:
        The gradient by the queries, [B, N, 3]; empty if not wanted.
    """
    natives = {"cpu": cpu.implicit_backward, "cuda": cuda.implicit_backward}
    native = natives.get(gradient.device.type, implicit_backward_reference)
    run = native if choose_backend(backend, gradient.device) == "native" else implicit_backward_reference
    roots = (gradient, canonical, query, jacobian_inverse)
    return run(*roots, lower, upper, shape, batch, count, wants_points, into is not None, into)[0]


register_native(implicit_backward, "cpu", cpu.implicit_backward, implicit_backward_reference)
register_native(implicit_backward, "cuda", cuda.implicit_backward, implicit_backward_reference)
implicit_backward.register_autograd(raise_for_second_derivative)


@implicit_backward.register_fake
def _(gradient, canonical, query, inverse, lower, upper, shape, batch, count, wants_points, wants_transforms, backend):
    nodes = shape[0] * shape[1] * shape[2]
    v_points = gradient.new_empty((batch, count, 3) if wants_points else 0)
    return v_points, gradient.new_empty((batch, nodes, 12) if wants_transforms else 0)
