"""The searches and their gradient as PyTorch operators: seen by autograd, torch.compile and every device alike.

An operator checks nothing; `find_correspondences` does. Each has a kernel for CPU tensors (the native library, or the readable
version in PyTorch) and one for CUDA tensors, a fake kernel that only knows shapes, and the implicit gradient of SNARF Eq. 14.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

from snarfcli.deformer.blending import refuse_second_derivative
from snarfcli.deformer.broyden import broyden_roots
from snarfcli.deformer.complete import complete_roots
from snarfcli.deformer.grid import CanonicalGrid, cell_corners, locate, trilinear_weights
from snarfcli.deformer.roots import Roots
from snarfcli.native import cpu, cuda
from snarfcli.native.cuda_compile import nvrtc_version
from snarfcli.native.library import choose_backend

__all__ = ["broyden_search", "complete_search", "implicit_backward", "implicit_backward_reference"]


@torch.library.custom_op("snarf::complete_search", mutates_args=())
def complete_search(
    points: Tensor,
    transforms: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    active_cells: Tensor | None,
    tolerance: float,
    max_steps: int,
    orientation_preserving: bool,
    capacity: int | None,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find the roots of T(x) [x; 1] = x' in every active cell of the grid.

    Args:
        points: queries [B, N, 3], posed space, metres.
        transforms: blended transforms [B, D * H * W, 12] at the nodes.
        lower, upper: corners of the grid's box, [3], canonical space, metres.
        shape: nodes (D, H, W).
        active_cells: bool [D-1, H-1, W-1]; None for all.
        tolerance: largest residual of a root, as a share of the box's longest side.
        max_steps: most Newton steps from one start.
        orientation_preserving: keep only roots where the Jacobian's determinant is positive.
        capacity: length of the results, padded with query B * N; None for as many as there are roots.
        backend: "auto", "native" or "reference".

    Returns:
        canonical [M, 3], query [M], jacobian_inverse [M, 3, 3], and the number of roots found, [1].
    """
    grid, nodes = _grid(lower, upper, shape)
    if points.is_cuda and _choose_cuda(backend) == "native":
        box = (lower, upper, shape)
        return cuda.complete_search(
            points, transforms, *box, active_cells, tolerance, max_steps, orientation_preserving, capacity
        )
    metres = tolerance * grid.longest_side
    if not points.is_cuda and choose_backend(backend) == "native":
        size = grid.cell_size(nodes)
        found = cpu.complete_search(
            points, transforms, lower, size, nodes, active_cells, metres, max_steps, orientation_preserving
        )
    else:
        settings = {"active_cells": active_cells, "tolerance": metres, "max_steps": max_steps}
        with torch.autocast(points.device.type, enabled=False):
            roots = complete_roots(points, transforms, grid, nodes, **settings)
        found = _reference_result(roots, orientation_preserving)
    return _padded(*found, points, capacity)


@torch.library.custom_op("snarf::broyden_search", mutates_args=())
def broyden_search(
    points: Tensor,
    transforms: Tensor,
    starts: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    tolerance: float,
    divergence: float,
    max_steps: int,
    exact_jacobian: bool,
    orientation_preserving: bool,
    capacity: int | None,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Run Broyden's method from the images of each query under `starts`; otherwise as `complete_search`.

    Args:
        starts: upper three rows of the inverse transforms of the start bones, [B, I, 12], posed to canonical.
        divergence: residual at which a start is given up, as a share of the box's longest side.
        exact_jacobian: whether the inverse Jacobian is the exact one at the root or the iteration's approximation.
    """
    grid, nodes = _grid(lower, upper, shape)
    rest = (max_steps, exact_jacobian, orientation_preserving)
    if points.is_cuda and _choose_cuda(backend) == "native":
        box = (lower, upper, shape)
        return cuda.broyden_search(points, transforms, starts, *box, tolerance, divergence, *rest, capacity)
    metres = (tolerance * grid.longest_side, divergence * grid.longest_side)
    if not points.is_cuda and choose_backend(backend) == "native":
        found = cpu.broyden_search(points, transforms, starts, lower, grid.cell_size(nodes), nodes, *metres, *rest)
    else:
        keys = ("exact_jacobian", "tolerance", "divergence", "max_steps")
        settings = dict(zip(keys, (exact_jacobian, *metres, max_steps), strict=True))
        with torch.autocast(points.device.type, enabled=False):
            roots = broyden_roots(points, transforms, starts, grid, nodes, **settings)
        found = _reference_result(roots, orientation_preserving)
    return _padded(*found, points, capacity)


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
        gradient: of the loss by the roots, [M, 3].
        canonical, query, jacobian_inverse: as the search returned them.

    Source: SNARF Eq. 14.
    """
    grid, nodes = _grid(lower, upper, shape)
    wants = (wants_points, wants_transforms)
    roots = (gradient, canonical, query, jacobian_inverse)
    if gradient.is_cuda and _choose_cuda(backend) == "native":
        return cuda.implicit_backward(*roots, lower, upper, shape, batch, count, *wants)
    if not gradient.is_cuda and choose_backend(backend) == "native":
        return cpu.implicit_backward(*roots, lower, grid.cell_size(nodes), nodes, batch, count, wants)
    return implicit_backward_reference(*roots, grid, nodes, batch, count, wants)


def implicit_backward_reference(
    gradient: Tensor,
    canonical: Tensor,
    query: Tensor,
    jacobian_inverse: Tensor,
    grid: CanonicalGrid,
    shape: tuple[int, int, int],
    batch: int,
    count: int,
    wants: tuple[bool, bool],
) -> tuple[Tensor, Tensor]:
    """The readable version of `implicit_backward`.

    With g the gradient by x*, implicit differentiation gives v = J^-T g for the query, and -v outer [x*; 1], weighted
    trilinearly, for each of the eight nodes of the root's cell.
    """
    known = (query < batch * count).nonzero()[:, 0]
    gradient, canonical, query = gradient[known], canonical[known], query[known]
    v = (jacobian_inverse[known] * gradient[:, :, None]).sum(1)
    v_points, v_transforms = gradient.new_empty(0), gradient.new_empty(0)
    if wants[0]:
        v_points = gradient.new_zeros(batch * count, 3).index_add(0, query, v).reshape(batch, count, 3)
    if wants[1]:
        nodes = shape[0] * shape[1] * shape[2]
        cell, local = locate(canonical, grid, shape)
        at = cell_corners(cell, shape) + (query // max(count, 1) * nodes)[:, None]
        homogeneous = torch.cat([canonical, torch.ones_like(canonical[:, :1])], 1)
        v_blended = -(v[:, :, None] * homogeneous[:, None]).reshape(-1, 12)
        v_corners = trilinear_weights(local)[..., None] * v_blended[:, None]
        v_transforms = gradient.new_zeros(batch * nodes, 12).index_add(0, at.reshape(-1), v_corners.reshape(-1, 12))
        v_transforms = v_transforms.reshape(batch, nodes, 12)
    return v_points, v_transforms


def _grid(lower: Tensor, upper: Tensor, shape: Sequence[int]) -> tuple[CanonicalGrid, tuple[int, int, int]]:
    return CanonicalGrid(lower, upper, checked=True), (shape[0], shape[1], shape[2])


def _choose_cuda(backend: str) -> str:
    """Return "native" or "reference" for tensors on a GPU, as `choose_backend` does for those on a CPU."""
    if backend == "reference":
        return backend
    reason = _why_no_kernels()
    if reason is None:
        return "native"
    if backend == "native":
        raise RuntimeError(f"backend native is not available on this GPU: {reason}")
    return "reference"


@cache
def _why_no_kernels() -> str | None:
    """Return why the CUDA kernels cannot be compiled, after a warning, or None."""
    try:
        nvrtc_version()
    except (RuntimeError, OSError) as error:
        warnings.warn(
            f"snarf searches with its reference in PyTorch, many times slower than its CUDA kernels: {error}",
            RuntimeWarning,
            stacklevel=2,
        )
        return str(error)
    return None


def _reference_result(roots: Roots, orientation_preserving: bool) -> tuple[Tensor, Tensor, Tensor]:
    if orientation_preserving:
        roots = roots.take((torch.linalg.det(roots.jacobian_inverse) > 0).nonzero()[:, 0])
    return roots.canonical, roots.query, roots.jacobian_inverse


def _padded(
    canonical: Tensor, query: Tensor, jacobian_inverse: Tensor, points: Tensor, capacity: int | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut or fill the results to `capacity` rows."""
    found = torch.tensor([len(query)], device=query.device)
    if capacity is None:
        return canonical, query, jacobian_inverse, found
    kept = min(capacity, len(query))
    out = (
        points.new_zeros(capacity, 3),
        query.new_full((capacity,), points.shape[0] * points.shape[1]),
        points.new_zeros(capacity, 3, 3),
    )
    for filled, values in zip(out, (canonical, query, jacobian_inverse), strict=True):
        filled[:kept] = values[:kept]
    return *out, found


# ---------------------------------------------------------------- shapes
def _fake_roots(points: Tensor, capacity: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rows = torch.library.get_ctx().new_dynamic_size() if capacity is None else capacity
    long = {"dtype": torch.long}
    return points.new_empty(rows, 3), points.new_empty(rows, **long), points.new_empty(rows, 3, 3), points.new_empty(1, **long)


@complete_search.register_fake
def _(points, transforms, lower, upper, shape, active_cells, tolerance, max_steps, orientation_preserving, capacity, backend):
    return _fake_roots(points, capacity)


@broyden_search.register_fake
def _(points, transforms, starts, lower, upper, shape, tolerance, divergence, max_steps, exact, preserving, capacity, backend):
    return _fake_roots(points, capacity)


@implicit_backward.register_fake
def _(gradient, canonical, query, inverse, lower, upper, shape, batch, count, wants_points, wants_transforms, backend):
    nodes = shape[0] * shape[1] * shape[2]
    v_points = gradient.new_empty((batch, count, 3) if wants_points else 0)
    return v_points, gradient.new_empty((batch, nodes, 12) if wants_transforms else 0)


# ---------------------------------------------------------------- gradients
def _remember(ctx, inputs, output, lower: int) -> None:
    """Keep what the gradient needs; `lower` is where the grid's box stands among the inputs."""
    points, backend = inputs[0], inputs[-1]
    canonical, query, jacobian_inverse, _ = output
    ctx.save_for_backward(canonical, query, jacobian_inverse, inputs[lower], inputs[lower + 1])
    ctx.mark_non_differentiable(query, jacobian_inverse, output[3])
    ctx.shape, ctx.backend, ctx.size = inputs[lower + 2], backend, points.shape[:2]
    ctx.inputs = len(inputs)


def _backward(ctx, gradient, *_):
    canonical, query, jacobian_inverse, lower, upper = ctx.saved_tensors
    wants = ctx.needs_input_grad[0], ctx.needs_input_grad[1]
    v_points, v_transforms = implicit_backward(
        gradient, canonical, query, jacobian_inverse, lower, upper, ctx.shape, *ctx.size, *wants, ctx.backend
    )
    rest = [None] * (ctx.inputs - 2)
    return v_points if wants[0] else None, v_transforms if wants[1] else None, *rest


complete_search.register_autograd(_backward, setup_context=lambda ctx, inputs, output: _remember(ctx, inputs, output, 2))
broyden_search.register_autograd(_backward, setup_context=lambda ctx, inputs, output: _remember(ctx, inputs, output, 3))
implicit_backward.register_autograd(refuse_second_derivative)
