"""Values at some nodes of a grid, extended to the others as heat is at rest."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["harmonic"]

_MOST_STEPS = 2000


def harmonic(start: Tensor, fixed: Tensor, cell_size: Tensor, solved: float) -> Tensor:
    """Solve Laplace's equation on a grid: the mean of its neighbours at each free node, with nothing flowing over the border.

    Conjugate gradients, all J right-hand sides at once, with the diagonal as preconditioner.

    Args:
        start: [D, H, W, J], values that are kept at fixed nodes, and from which the search starts at free ones.
        fixed: [D, H, W], bool.
        cell_size: [3], along x, y, z, metres; neighbours count by 1 / distance^2.
        solved: largest change of a value by one more step. For weights: with 1e-5 none differs from that with 1e-4 by more than
            0.5 %.

    Returns:
        [D, H, W, J].
    """
    free = (~fixed)[..., None].to(start)
    conductance = [1 / cell_size[2 - axis].square() for axis in range(3)]

    def laplacian(values: Tensor) -> Tensor:
        out = torch.zeros_like(values)
        for axis in range(3):
            count = values.shape[axis] - 1
            flow = conductance[axis] * (values.narrow(axis, 1, count) - values.narrow(axis, 0, count))
            out.narrow(axis, 0, count).sub_(flow)
            out.narrow(axis, 1, count).add_(flow)
        return out

    diagonal = torch.zeros_like(free)
    for axis in range(3):
        count = free.shape[axis] - 1
        diagonal.narrow(axis, 0, count).add_(conductance[axis])
        diagonal.narrow(axis, 1, count).add_(conductance[axis])
    values = start.clone()
    residual = -laplacian(values) * free
    scaled = residual / diagonal
    direction = scaled.clone()
    size = (residual * scaled).sum((0, 1, 2))
    for _ in range(_MOST_STEPS):
        if not bool((scaled.abs() > solved).any()):
            break
        moved = laplacian(direction) * free
        length = size / (direction * moved).sum((0, 1, 2)).clamp_min(1e-30)
        values = values + length * direction
        residual = residual - length * moved
        scaled = residual / diagonal
        before, size = size, (residual * scaled).sum((0, 1, 2))
        direction = scaled + (size / before.clamp_min(1e-30)) * direction
    return values
