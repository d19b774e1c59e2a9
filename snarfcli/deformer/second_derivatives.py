"""Gradients that are exact but computed without a graph: differentiating them again raises, and is never silently wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor

__all__ = ["differentiable_once", "raise_for_second_derivative"]


def raise_for_second_derivative(ctx, *gradients):
    """Raise RuntimeError: the gradient of a gradient operator."""
    raise RuntimeError(
        "the second derivative of a correspondence search is not available: its gradient is exact, but is itself computed "
        "without a graph; call backward() or autograd.grad() without create_graph=True"
    )


def differentiable_once(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate the `backward` of an autograd.Function whose results depend on saved tensors or gradients that have a graph.

    PyTorch's `once_differentiable` looks at the gradients alone: of the sum of roots it lets the second derivative, which is
    that of J^-T, vanish without a word. What the results depend on must be among the saved tensors, outputs included.
    """

    @wraps(backward)
    def guarded(ctx, *gradients):
        with torch.no_grad():
            results = backward(ctx, *gradients)
        if not torch.is_grad_enabled():
            return results
        causes = [tensor for tensor in (*gradients, *ctx.saved_tensors) if tensor is not None and tensor.requires_grad]
        if not causes:
            return results
        several = results if isinstance(results, tuple) else (results,)
        return tuple(None if result is None else _Final.apply(result, *causes) for result in several)

    return guarded


class _Final(torch.autograd.Function):
    """Passes a gradient on as one that depends on the others, but has no derivative."""

    @staticmethod
    def forward(ctx, gradient: Tensor, *causes: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    backward = staticmethod(raise_for_second_derivative)
