"""The searches as torch.library operators with autograd, fake kernels and per-device implementations.

An operator does not check its arguments; `find_correspondences` does. The default kernel of each is the readable reference in
PyTorch, for every type of device. CPU and CUDA tensors have native kernels as well, chosen by the argument `backend`. The
gradient is the implicit one of SNARF Eq. 14.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from snarfcli.deformer.broyden import broyden_roots
from snarfcli.deformer.complete import complete_roots
from snarfcli.deformer.implicit import implicit_backward
from snarfcli.deformer.operators import grid_of, register_native
from snarfcli.deformer.roots import Roots
from snarfcli.native import cpu, cuda
from snarfcli.native.backend import choose_backend
from snarfcli.native.capacity import fit_to_capacity

__all__ = [
    "broyden_search",
    "broyden_search_reference",
    "complete_search",
    "complete_search_reference",
]

Results = tuple[Tensor, Tensor, Tensor, Tensor]


# ---------------------------------------------------------------- complete search
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
        points: [B, N, 3], queries, posed space, metres.
        transforms: [B, D * H * W, 12], blended transforms at the nodes.
        lower, upper: [3], corners of the grid's box, canonical space, metres.
        shape: nodes (D, H, W).
        active_cells: [D-1, H-1, W-1], bool; None for all.
        tolerance: largest residual of a root, as a share of the box's longest side.
        max_steps: maximum number of Newton steps from one start.
        orientation_preserving: keep only roots where the Jacobian's determinant is positive.
        capacity: length of the results, padded with query B * N; None for the number of roots.
        backend: "auto", "native" or "reference".

    Returns:
        canonical [M, 3], query [M], jacobian_inverse [M, 3, 3], and the number of roots found, [1].
    """
    choose_backend(backend, points.device.type)  # raises for "native", warns for "auto": there are no native kernels
    return complete_search_reference(
        points, transforms, lower, upper, shape, active_cells, tolerance, max_steps, orientation_preserving, capacity
    )


def complete_search_reference(
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
) -> Results:
    """The readable version of `complete_search`."""
    grid, nodes = grid_of(lower, upper, shape)
    metres = tolerance * grid.longest_side
    with torch.autocast(points.device.type, enabled=False):
        roots = complete_roots(
            points, transforms, grid, nodes, active_cells=active_cells, tolerance=metres, max_steps=max_steps
        )
    return fit_to_capacity(*_reference_result(roots, orientation_preserving), points, capacity)


# ---------------------------------------------------------------- broyden search
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
    """Run Broyden's method from every start of each query; otherwise as `complete_search`.

    Args:
        starts: [B, I, 12], upper three rows of the inverse transforms of the start bones, posed to canonical: a query starts
            from its images under them. Or [B, N, I, 3], canonical points, metres; one that is not finite is no start.
        divergence: residual after a step at which a start is given up, as a share of the box's longest side.
        exact_jacobian: whether the inverse Jacobian is the exact one at the root or the iteration's approximation.
    """
    choose_backend(backend, points.device.type)  # raises for "native", warns for "auto": there are no native kernels
    settings = (tolerance, divergence, max_steps, exact_jacobian, orientation_preserving, capacity)
    return broyden_search_reference(points, transforms, starts, lower, upper, shape, *settings)


def broyden_search_reference(
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
) -> Results:
    """The readable version of `broyden_search`."""
    grid, nodes = grid_of(lower, upper, shape)
    with torch.autocast(points.device.type, enabled=False):
        roots = broyden_roots(
            points,
            transforms,
            starts,
            grid,
            nodes,
            exact_jacobian=exact_jacobian,
            tolerance=tolerance * grid.longest_side,
            divergence=divergence * grid.longest_side,
            max_steps=max_steps,
        )
    return fit_to_capacity(*_reference_result(roots, orientation_preserving), points, capacity)


# ---------------------------------------------------------------- native kernels
register_native(complete_search, "cpu", cpu.complete_search, complete_search_reference)
register_native(complete_search, "cuda", cuda.complete_search, complete_search_reference)
register_native(broyden_search, "cpu", cpu.broyden_search, broyden_search_reference)
register_native(broyden_search, "cuda", cuda.broyden_search, broyden_search_reference)


def _reference_result(roots: Roots, orientation_preserving: bool) -> tuple[Tensor, Tensor, Tensor]:
    if orientation_preserving:
        roots = roots.take((torch.linalg.det(roots.jacobian_inverse) > 0).nonzero()[:, 0])
    return roots.canonical, roots.query, roots.jacobian_inverse


# ---------------------------------------------------------------- shapes
def _fake_roots(points: Tensor, capacity: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rows = torch.library.get_ctx().new_dynamic_size() if capacity is None else capacity
    query, total = (points.new_empty(size, dtype=torch.long) for size in (rows, 1))
    return points.new_empty(rows, 3), query, points.new_empty(rows, 3, 3), total


@complete_search.register_fake
def _(points, transforms, lower, upper, shape, active_cells, tolerance, max_steps, orientation_preserving, capacity, backend):
    return _fake_roots(points, capacity)


@broyden_search.register_fake
def _(points, transforms, starts, lower, upper, shape, tolerance, divergence, max_steps, exact, preserving, capacity, backend):
    return _fake_roots(points, capacity)


# ---------------------------------------------------------------- gradients
def _save_for_backward(ctx, inputs, output, lower: int) -> None:
    """Keep what the gradient needs; `lower` is where the grid's box stands among the inputs."""
    points, backend = inputs[0], inputs[-1]
    canonical, query, jacobian_inverse, _ = output
    ctx.save_for_backward(canonical, query, jacobian_inverse, inputs[lower], inputs[lower + 1])
    ctx.mark_non_differentiable(query, jacobian_inverse, output[3])
    ctx.set_materialize_grads(False)
    ctx.shape, ctx.backend, ctx.size = inputs[lower + 2], backend, points.shape[:2]
    ctx.inputs = len(inputs)


def _backward(ctx, gradient, *_):
    if gradient is None:
        return (None,) * ctx.inputs
    canonical, query, jacobian_inverse, lower, upper = ctx.saved_tensors
    wants = ctx.needs_input_grad[0], ctx.needs_input_grad[1]
    v_points, v_transforms = implicit_backward(
        gradient, canonical, query, jacobian_inverse, lower, upper, ctx.shape, *ctx.size, *wants, ctx.backend
    )
    rest = [None] * (ctx.inputs - 2)
    return v_points if wants[0] else None, v_transforms if wants[1] else None, *rest


for _operator, _lower in ((complete_search, 2), (broyden_search, 3)):
    _operator.register_autograd(_backward, setup_context=partial(_save_for_backward, lower=_lower))
