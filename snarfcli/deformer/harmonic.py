"""Values at some nodes of a grid, extended to the others as heat is at rest."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from snarfcli.deformer.multigrid import Multigrid

__all__ = ["harmonic"]

_MOST_STEPS = 100  # a step divides the error by about four; all are taken only where the numbers are not precise enough
_VALUES_AT_ONCE = 2**20  # bounds the memory; columns that are solved together stay in a processor's cache


def harmonic(
    start: Tensor, fixed: Tensor, cell_size: Tensor, solved: float, progress: Callable[[int], object] | None = None
) -> Tensor:
    """Solve Laplace's equation on a grid: the mean of its neighbours at each free node, with nothing flowing over the border.

    Conjugate gradients, several columns at once, with a multigrid cycle as preconditioner; the number of steps hardly depends
    on the number of nodes.

    Args:
        start: [D, H, W, J], values that are kept at fixed nodes, and from which the search starts at free ones.
        fixed: [D, H, W], bool, at least one.
        cell_size: [3], along x, y, z, metres; neighbours count by 1 / distance^2.
        solved: largest change of a value by one more cycle. The largest error is about the same (1.3e-3 with 1e-3 on
            128 x 128 x 32 nodes around the built-in body).
        progress: called with the number of columns that have been solved since the call before.

    Returns:
        [D, H, W, J].
    """
    multigrid = Multigrid(~fixed, cell_size.flip(0))
    columns = start.permute(3, 0, 1, 2)
    at_once = max(1, _VALUES_AT_ONCE // fixed.numel())
    values = torch.empty_like(start)
    for first in range(0, len(columns), at_once):
        some = columns[first : first + at_once].contiguous()
        values[..., first : first + at_once] = _solve(some, multigrid, solved).permute(1, 2, 3, 0)
        if progress is not None:
            progress(len(some))
    return values


def _solve(values: Tensor, multigrid: Multigrid, solved: float) -> Tensor:
    """Solve for columns [K, D, H, W]."""
    residual = multigrid.residuals(values)
    direction, before = torch.zeros_like(values), None
    for _ in range(_MOST_STEPS):
        correction = multigrid.cycle(residual)
        if not bool((correction.abs() > solved).any()):
            return values + correction
        size = (residual * correction).sum((1, 2, 3), keepdim=True)
        share = torch.zeros_like(size) if before is None else size / before.clamp_min(1e-30)
        direction, before = torch.addcmul(correction, share, direction), size
        moved = multigrid.apply(direction)
        length = size / (direction * moved).sum((1, 2, 3), keepdim=True).clamp_min(1e-30)
        values = torch.addcmul(values, length, direction)
        residual = torch.addcmul(residual, length, moved, value=-1)
    return values
