"""The total variation of skinning weights on a grid, as a torch.library operator."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.native import cpu, cuda_variation
from snarfcli.native.backend import choose_backend

__all__ = ["total_variation", "variation", "variation_reference"]

_KERNELS = {"cpu": cpu.total_variation, "cuda": cuda_variation.total_variation}  # by the type of device


def total_variation(weights: Tensor, grid: CanonicalGrid, used: Tensor | None = None) -> Tensor:
    """Return the change of weights from node to node, per metre: summed over bones and axes, averaged over neighbours.

    The same field has the same value on a finer grid.

    Args:
        weights: [D, H, W, J], at the grid nodes.
        grid: the box of the nodes.
        used: [D, H, W], bool; only pairs of these nodes count. None for all.

    Source: the regulariser that Fast-SNARF Sec. 4.2 mentions; the norm is our choice.
    """
    size = grid.cell_size(weights.shape[:3])
    if _has_kernel(weights, size):
        return variation(weights, size, used)[0]
    return variation_reference(weights, size, used)


def _has_kernel(weights: Tensor, size: Tensor) -> bool:
    """Return whether native kernels take these arguments on this device."""
    takes = weights.dtype == size.dtype == torch.float32 and weights.device.type in _KERNELS
    return takes and choose_backend("auto", weights.device) == "native"


def variation_reference(weights: Tensor, size: Tensor, used: Tensor | None) -> Tensor:
    """The readable version of `variation`, without its gradient."""
    total = weights.new_zeros(())
    for axis in range(3):  # z, y, x
        count = weights.shape[axis] - 1
        if not count:
            continue
        change = (weights.narrow(axis, 1, count) - weights.narrow(axis, 0, count)).abs().sum(-1) / size[2 - axis]
        if used is None:
            total = total + change.mean()
        else:
            pairs = used.narrow(axis, 1, count) & used.narrow(axis, 0, count)
            total = total + (change * pairs).sum() / pairs.sum().clamp_min(1)
    return total


@torch.library.custom_op("snarf::variation", mutates_args=())
def variation(weights: Tensor, size: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the total variation of weights [D, H, W, J], [], and its gradient.

    Args:
        weights: [D, H, W, J].
        size: [3], sides of a cell along x, y, z, metres.
        used: [D, H, W], bool; only pairs of these nodes count. None for all.
    """
    return _with_gradient(weights, size, used)


def _with_gradient(weights: Tensor, size: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
    total, back, *_ = torch.func.vjp(lambda given: variation_reference(given, size, used), weights)
    return total, back(torch.ones_like(total))[0]


@variation.register_kernel(["cpu", "cuda"])
def _(weights, size, used):
    run = _KERNELS[weights.device.type] if _has_kernel(weights, size) else _with_gradient
    return run(weights, size, used)


@variation.register_fake
def _(weights, size, used):
    return weights.new_empty(()), torch.empty_like(weights)


def _remember(ctx, inputs, output):
    ctx.save_for_backward(output[1])
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)


def _gradient(ctx, gradient, _):
    return None if gradient is None else gradient * ctx.saved_tensors[0], None, None


variation.register_autograd(_gradient, setup_context=_remember)
