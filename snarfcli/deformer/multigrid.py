"""Multigrid cycles for Laplace's equation on a grid with any set of fixed nodes.

A level is a network of conductors: nodes, conductances between neighbours along the three axes, and conductances to the fixed
nodes, where errors are zero. The next level joins pairs of neighbours along some axes: conductors within a pair vanish,
parallel ones add up, and those along the axes count half, since joined nodes are twice as far apart.

All values, errors and residuals are columns [K, D, H, W].
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["Multigrid"]

_RELAXED = 0.8  # share of a Jacobi step that smooths well
_FEW = 64  # nodes of the last level, which is solved exactly
_SIMILAR = 1.5  # nodes are joined along axes with distances up to this many times the shortest, until all are similar


class Multigrid:
    """Levels of a grid.

    Args:
        free: [D, H, W], bool; the other nodes, at least one, are fixed.
        distances: [3], between neighbours along z, y, x; conductances are 1 / distance^2.
    """

    def __init__(self, free: Tensor, distances: Tensor) -> None:
        weights, mask = distances.square().reciprocal(), free.to(distances)
        # Between all nodes, fixed ones too; `inner` are those between free nodes.
        self._conductances = [weight.expand(_neighbours(mask, axis)[0].shape) for axis, weight in enumerate(weights)]
        inner = [conductance * torch.mul(*_neighbours(mask, axis)) for axis, conductance in enumerate(self._conductances)]
        level = _Level(mask, inner, mask * (_at_ends(self._conductances, mask) - _at_ends(inner, mask)).clamp_min(0))
        self._levels, spacing = [level], distances.tolist()
        while level.mask.numel() > _FEW:
            counts = level.mask.shape
            shortest = min(distance for distance, count in zip(spacing, counts, strict=True) if count > 1)
            level.joined = [axis for axis in range(3) if counts[axis] > 1 and spacing[axis] <= _SIMILAR * shortest]
            spacing = [distance * (2 if axis in level.joined else 1) for axis, distance in enumerate(spacing)]
            level = level.coarser()
            self._levels.append(level)
        self._inverse = level.inverse()

    def residuals(self, values: Tensor) -> Tensor:
        """Return the sum of flows into each free node, which is 0 for a solution; 0 at fixed nodes."""
        into = torch.zeros_like(values)
        for axis, conductance in enumerate(self._conductances):
            lower, upper = _neighbours(values, axis)
            into_lower, into_upper = _neighbours(into, axis)
            flow = conductance * (upper - lower)
            into_lower += flow
            into_upper -= flow
        return into * self._levels[0].mask

    def apply(self, errors: Tensor) -> Tensor:
        """Return the residuals of errors that are 0 at fixed nodes."""
        return self._levels[0].apply(errors)

    def cycle(self, residuals: Tensor, depth: int = 0) -> Tensor:
        """Return roughly the errors of residuals: one V-cycle, a symmetric and positive linear map."""
        level = self._levels[depth]
        if level is self._levels[-1]:
            return (residuals.flatten(1) @ self._inverse).reshape(residuals.shape)
        errors = level.relaxed * residuals
        rest = (residuals - level.apply(errors)) * level.mask
        for axis in level.joined:
            rest = _joined(rest, axis)
        coarse = self.cycle(rest, depth + 1)
        for axis in level.joined:
            coarse = _parted(coarse, axis, level.mask.shape[axis])
        errors = torch.addcmul(errors, level.mask, coarse)
        return torch.addcmul(errors, level.relaxed, residuals - level.apply(errors))


class _Level:
    """One network.

    Args:
        mask: [D, H, W], 1 at free nodes and 0 at others, which nothing is connected to.
        conductances: between neighbours along z, y, x.
        ground: [D, H, W], conductances to fixed nodes.
    """

    joined: list[int]
    """Axes along which the next level joins nodes."""

    def __init__(self, mask: Tensor, conductances: list[Tensor], ground: Tensor) -> None:
        self.mask, self._conductances, self._ground = mask, conductances, ground
        self._diagonal = torch.where(mask > 0, _at_ends(conductances, ground) + ground, 1)
        self.relaxed = _RELAXED * mask / self._diagonal
        """[D, H, W], the change of an error for a residual in a step of Jacobi's method."""

    def apply(self, errors: Tensor) -> Tensor:
        """Return the residuals of errors."""
        out = errors * self._diagonal
        for axis, conductance in enumerate(self._conductances):
            (lower, upper), (out_lower, out_upper) = _neighbours(errors, axis), _neighbours(out, axis)
            out_lower.addcmul_(conductance, upper, value=-1)
            out_upper.addcmul_(conductance, lower, value=-1)
        return out

    def coarser(self) -> _Level:
        """Return the network of joined nodes; those are free that have a free node in them."""
        mask, conductances, ground = self.mask, list(self._conductances), self._ground
        for axis in self.joined:
            between = torch.arange(1, conductances[axis].shape[axis], 2, device=mask.device)
            conductances = [
                0.5 * conductance.index_select(axis, between) if along == axis else _sum_of_pairs(conductance, axis)
                for along, conductance in enumerate(conductances)
            ]
            mask, ground = _sum_of_pairs(mask, axis), _sum_of_pairs(ground, axis)
        return _Level((mask > 0).to(mask), conductances, ground)

    def inverse(self) -> Tensor:
        """Return the matrix [n, n] from residuals to errors, n = D * H * W."""
        count = self.mask.numel()
        identity = torch.eye(count, dtype=self.mask.dtype, device=self.mask.device)
        matrix = self.apply(identity.reshape(count, *self.mask.shape)).reshape(count, count)
        mask = self.mask.reshape(-1)
        return torch.linalg.inv(matrix) * mask[:, None] * mask


def _neighbours(values: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the values at the lower and at the upper ends of all connections along an axis of [..., D, H, W], as views."""
    count = values.shape[axis - 3] - 1
    return values.narrow(axis - 3, 0, count), values.narrow(axis - 3, 1, count)


def _at_ends(conductances: list[Tensor], like: Tensor) -> Tensor:
    """Return the sum of the conductances of all connections of each node, [D, H, W]."""
    total = torch.zeros_like(like)
    for axis, conductance in enumerate(conductances):
        for end in _neighbours(total, axis):
            end += conductance
    return total


def _pairs(values: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the first and the second values of pairs along an axis of [..., D, H, W]; a second one that is missing is 0."""
    axis -= 3
    if values.shape[axis] % 2:
        values = torch.cat([values, torch.zeros_like(values.narrow(axis, 0, 1))], axis)
    first, second = values.unflatten(axis, (-1, 2)).unbind(axis)
    return first, second


def _sum_of_pairs(values: Tensor, axis: int) -> Tensor:
    return torch.add(*_pairs(values, axis))


def _joined(values: Tensor, axis: int) -> Tensor:
    """Return residuals of joined nodes, three quarters of which are their own and a quarter their neighbours'."""
    first, second = _pairs(values, axis)
    out = 0.75 * (first + second)
    below, above = _neighbours(out, axis)
    below.add_(_neighbours(first, axis)[1], alpha=0.25)
    above.add_(_neighbours(second, axis)[0], alpha=0.25)
    out.narrow(axis - 3, 0, 1).add_(first.narrow(axis - 3, 0, 1), alpha=0.25)
    out.narrow(axis - 3, -1, 1).add_(second.narrow(axis - 3, -1, 1), alpha=0.25)
    return out


def _parted(values: Tensor, axis: int, count: int) -> Tensor:
    """Return errors at `count` nodes, interpolated linearly between those of joined nodes; the transpose of `_joined`."""
    first = 0.75 * values
    second = first.clone()
    below, above = _neighbours(values, axis)
    _neighbours(first, axis)[1].add_(below, alpha=0.25)
    _neighbours(second, axis)[0].add_(above, alpha=0.25)
    first.narrow(axis - 3, 0, 1).add_(values.narrow(axis - 3, 0, 1), alpha=0.25)
    second.narrow(axis - 3, -1, 1).add_(values.narrow(axis - 3, -1, 1), alpha=0.25)
    return torch.stack([first, second], axis - 3).flatten(axis - 4, axis - 3).narrow(axis - 3, 0, count)
