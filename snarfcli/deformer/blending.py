"""The bone transforms blended once per grid node, as a PyTorch operator of full precision."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.precision import matmul_precision

__all__ = ["blend", "blend_backward", "refuse_second_derivative"]


@torch.library.custom_op("snarf::blend", mutates_args=())
def blend(weights: Tensor, bones: Tensor) -> Tensor:
    """Blend bone transforms [B, J, 12] with the weights [V, J] of V nodes to [B, V, 12].

    A product in full precision, forward and backward, whatever precision the caller allows for his matrix products: TF32
    would move a point by half a millimetre at one metre.

    Source: Fast-SNARF Eq. 13.
    """
    with matmul_precision("highest"):
        return torch.matmul(weights[None], bones)


@torch.library.custom_op("snarf::blend_backward", mutates_args=())
def blend_backward(gradient: Tensor, weights: Tensor, bones: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gradients of a loss by the weights and by the bones from that by the blended transforms [B, V, 12]."""
    v_weights = torch.zeros_like(weights, memory_format=torch.contiguous_format)
    with matmul_precision("highest"):
        for one, pose in zip(gradient, bones, strict=True):
            v_weights.addmm_(one, pose.T)
        return v_weights, torch.matmul(weights.T[None], gradient)


@blend.register_fake
def _(weights, bones):
    return bones.new_empty(len(bones), len(weights), bones.shape[2])


@blend_backward.register_fake
def _(gradient, weights, bones):
    return weights.new_empty(weights.shape), bones.new_empty(bones.shape)


def _blend_backward(ctx, gradient):
    v_weights, v_bones = blend_backward(gradient, *ctx.saved_tensors)
    return v_weights if ctx.needs_input_grad[0] else None, v_bones if ctx.needs_input_grad[1] else None


def refuse_second_derivative(ctx, *gradients):
    """Say why there is no second derivative; the gradient operators' own gradient."""
    raise RuntimeError(
        "the second derivative of a correspondence search is not available: its gradient is exact, but is itself computed "
        "without a graph; call backward() or autograd.grad() without create_graph=True"
    )


blend.register_autograd(_blend_backward, setup_context=lambda ctx, inputs, output: ctx.save_for_backward(*inputs))
blend_backward.register_autograd(refuse_second_derivative)
