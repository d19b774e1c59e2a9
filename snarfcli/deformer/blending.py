"""The bone transforms blended once per grid node, as a PyTorch operator of full precision."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.native import cpu
from snarfcli.native.library import choose_backend
from snarfcli.precision import matmul_precision

__all__ = ["blend", "blend_backward", "refuse_second_derivative"]


@torch.library.custom_op("snarf::blend", mutates_args=())
def blend(weights: Tensor, bones: Tensor, active_cells: Tensor | None, backend: str) -> Tensor:
    """Blend bone transforms [B, J, 12] with the weights [D, H, W, J] of the grid's nodes to [B, D * H * W, 12].

    In full precision, forward and backward, whatever precision the caller allows for matrix products: TF32 would move a point
    by half a millimetre at one metre.

    Args:
        active_cells: bool [D-1, H-1, W-1]; nodes that are no corner of an active cell need not be blended and get zeros, or
            what they would have got.
        backend: "auto", "native" or "reference".

    Source: Fast-SNARF Eq. 13.
    """
    if not weights.is_cuda and choose_backend(backend) == "native":
        return cpu.blend(weights, bones, active_cells)
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
    """Return the gradients of a loss by the weights and by the bones from that by `blend`'s result; empty where not wanted.

    The gradient by the result is taken to be zero at nodes that are no corner of an active cell.
    """
    if not weights.is_cuda and choose_backend(backend) == "native":
        return cpu.blend_backward(gradient, weights, bones, active_cells, (wants_weights, wants_bones))
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


@blend.register_fake
def _(weights, bones, active_cells, backend):
    depth, height, width, _ = weights.shape
    return bones.new_empty(len(bones), depth * height * width, 12)


@blend_backward.register_fake
def _(gradient, weights, bones, active_cells, wants_weights, wants_bones, backend):
    v_weights = weights.new_empty(weights.shape if wants_weights else 0)
    return v_weights, bones.new_empty(bones.shape if wants_bones else 0)


def _remember(ctx, inputs, output):
    weights, bones, active_cells, ctx.backend = inputs
    ctx.save_for_backward(weights, bones, active_cells)


def _backward(ctx, gradient):
    wants = ctx.needs_input_grad[0], ctx.needs_input_grad[1]
    v_weights, v_bones = blend_backward(gradient, *ctx.saved_tensors, *wants, ctx.backend)
    return v_weights if wants[0] else None, v_bones if wants[1] else None, None, None


def refuse_second_derivative(ctx, *gradients):
    """Say why there is no second derivative; the gradient operators' own gradient."""
    raise RuntimeError(
        "the second derivative of a correspondence search is not available: its gradient is exact, but is itself computed "
        "without a graph; call backward() or autograd.grad() without create_graph=True"
    )


blend.register_autograd(_backward, setup_context=_remember)
blend_backward.register_autograd(refuse_second_derivative)
