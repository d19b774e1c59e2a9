"""Bone transforms blended once per grid node, as a torch.library operator in full precision."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.second_derivatives import raise_for_second_derivative
from snarfcli.native import cpu
from snarfcli.native.backend import choose_backend
from snarfcli.precision import matmul_precision

__all__ = ["blend", "blend_backward"]


@torch.library.custom_op("snarf::blend", mutates_args=())
def blend(weights: Tensor, bones: Tensor, active_cells: Tensor | None, backend: str) -> Tensor:
    """Blend bone transforms [B, J, 12] with the weights [D, H, W, J] of the grid's nodes to [B, D * H * W, 12].

    Runs in full precision, forward and backward, also where the caller allows TF32: that would move a point by half a
    millimetre at one metre.

    Args:
        active_cells: [D-1, H-1, W-1], bool. Nodes that are not a corner of an active cell may get zeros; None for all cells.
        backend: "auto", "native" or "reference".

    Source: Fast-SNARF Eq. 13.
    """
    return _blend_reference(weights, bones)


def _blend_reference(weights: Tensor, bones: Tensor) -> Tensor:
    with matmul_precision("highest"), torch.autocast(weights.device.type, enabled=False):
        return torch.matmul(weights.reshape(1, -1, weights.shape[-1]), bones)


@torch.library.custom_op("snarf::blend_backward", mutates_args=())
def blend_backward(
    gradient: Tensor,
    weights: Tensor,
    bones: Tensor,
    active_cells: Tensor | None,
    wants_weights: bool,
    wants_bones: bool,
    backend: str,
) -> tuple[Tensor, Tensor]:
    """Return the gradients of a loss by the weights and by the bones, given its gradient by `blend`'s result.

    A gradient that is not wanted is empty. The given gradient counts as zero at nodes that are not a corner of an active cell.
    """
    return _blend_backward_reference(gradient, weights, bones, wants_weights, wants_bones)


def _blend_backward_reference(
    gradient: Tensor, weights: Tensor, bones: Tensor, wants_weights: bool, wants_bones: bool
) -> tuple[Tensor, Tensor]:
    flat = weights.reshape(-1, weights.shape[-1])
    v_weights, v_bones = weights.new_empty(0), bones.new_empty(0)
    with matmul_precision("highest"), torch.autocast(weights.device.type, enabled=False):
        if wants_weights:
            v_flat = torch.zeros_like(flat, memory_format=torch.contiguous_format)
            for one, pose in zip(gradient, bones, strict=True):
                v_flat.addmm_(one, pose.T)
            v_weights = v_flat.reshape(weights.shape)
        if wants_bones:
            v_bones = torch.matmul(flat.T[None], gradient)
    return v_weights, v_bones


# A matrix product is fast on other devices as it is: only the CPU has a native kernel.
@blend.register_kernel("cpu")
def _(weights, bones, active_cells, backend):
    if choose_backend(backend) == "native":
        return cpu.blend(weights, bones, active_cells)
    return _blend_reference(weights, bones)


@blend_backward.register_kernel("cpu")
def _(gradient, weights, bones, active_cells, wants_weights, wants_bones, backend):
    if choose_backend(backend) == "native":
        return cpu.blend_backward(gradient, weights, bones, active_cells, (wants_weights, wants_bones))
    return _blend_backward_reference(gradient, weights, bones, wants_weights, wants_bones)


@blend.register_fake
def _(weights, bones, active_cells, backend):
    depth, height, width, _ = weights.shape
    return bones.new_empty(len(bones), depth * height * width, 12)


@blend_backward.register_fake
def _(gradient, weights, bones, active_cells, wants_weights, wants_bones, backend):
    v_weights = weights.new_empty(weights.shape if wants_weights else 0)
    return v_weights, bones.new_empty(bones.shape if wants_bones else 0)


def _save_for_backward(ctx, inputs, output):
    weights, bones, active_cells, ctx.backend = inputs
    ctx.save_for_backward(weights, bones, active_cells)
    # Not read in the backward pass: PyTorch changes it there for an operator, though several threads may be in the same graph.
    ctx.wants = tuple(ctx.needs_input_grad[:2])


def _backward(ctx, gradient):
    wants = ctx.wants
    v_weights, v_bones = blend_backward(gradient, *ctx.saved_tensors, *wants, ctx.backend)
    return v_weights if wants[0] else None, v_bones if wants[1] else None, None, None


blend.register_autograd(_backward, setup_context=_save_for_backward)
blend_backward.register_autograd(raise_for_second_derivative)
