"""Gradients by the blended transforms of poses, gathered from all calls of a backward pass before they are passed on.

Each search or query of a pose that was prepared once depends on the transforms at all grid nodes, though it touches few of
them. Autograd would add up arrays of all nodes, call by call. Here the calls depend on a single number instead, the ticket, and
add their gradients to one array. Autograd comes to the function behind the ticket after all of them, and takes the array there.
"""

from __future__ import annotations

import threading
from weakref import WeakValueDictionary

import torch
from torch import Tensor
from torch.autograd import Variable

from snarfcli.deformer.second_derivatives import differentiable_once

__all__ = ["PoseGradients", "corners_of_poses"]


class PoseGradients:
    """The sum of the gradients by `transforms` [B, V, 12], one for each backward pass that is under way."""

    def __init__(self, transforms: Tensor) -> None:
        self._sums = _Sums(transforms.detach())
        self.ticket: Tensor = _Ticket.apply(transforms, self._sums)  # pyright: ignore[reportAttributeAccessIssue]
        """[], what a call takes in place of the transforms; requires a gradient if they do."""

    @property
    def transforms(self) -> Tensor:
        """[B, V, 12], without a gradient."""
        return self._sums.like

    def sum(self) -> Tensor:
        """Return the array [B, V, 12] to which a call adds its gradient, in the backward pass that is under way."""
        return self._sums.of_this_pass()


class _Sum:
    """The sum of one pass."""

    def __init__(self, total: Tensor) -> None:
        self.total: Tensor | None = total

    def take(self) -> Tensor | None:
        total, self.total = self.total, None
        return total

    def drop(self) -> None:
        self.total = None


class _Sums:
    """The sums of the passes that are under way; one that fails, or is not asked for the sum, leaves none behind."""

    def __init__(self, like: Tensor) -> None:
        self.like = like
        self._by_pass: WeakValueDictionary[int, _Sum] = WeakValueDictionary()
        self._lock = threading.Lock()

    def of_this_pass(self) -> Tensor:
        number = torch._C._current_graph_task_id()
        with self._lock:
            one = self._by_pass.get(number)
            if one is None or one.total is None:
                one = self._by_pass[number] = _Sum(torch.zeros_like(self.like))
                Variable._execution_engine.queue_callback(one.drop)  # only the pass holds the sum
            assert one.total is not None
            return one.total

    def take(self) -> Tensor | None:
        """Return the sum of the pass that is under way, and forget it; None if nothing was added."""
        with self._lock:
            one = self._by_pass.get(torch._C._current_graph_task_id())
            return None if one is None else one.take()


class _Ticket(torch.autograd.Function):
    @staticmethod
    def forward(ctx, transforms, sums):
        ctx.sums = sums
        return transforms.new_zeros(())

    @staticmethod
    @differentiable_once
    def backward(ctx, gradient):
        return ctx.sums.take(), None


def corners_of_poses(gradients: PoseGradients, nodes: Tensor) -> Tensor:
    """Return the transforms [K, 8, 12] at nodes [K, 8], numbered b * V + v; differentiable."""
    return _Corners.apply(gradients.ticket, gradients, nodes)  # pyright: ignore[reportReturnType]


class _Corners(torch.autograd.Function):
    @staticmethod
    def forward(ctx, ticket, gradients, nodes):
        ctx.gradients = gradients
        ctx.save_for_backward(nodes)
        return gradients.transforms.reshape(-1, 12).index_select(0, nodes.reshape(-1)).reshape(*nodes.shape, 12)

    @staticmethod
    @differentiable_once
    def backward(ctx, gradient):
        (nodes,) = ctx.saved_tensors
        ctx.gradients.sum().view(-1, 12).index_add_(0, nodes.reshape(-1), gradient.reshape(-1, 12))
        return gradient.new_zeros(()), None, None
