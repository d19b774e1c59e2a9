"""The result of a correspondence search: the roots of all queries, and what users gather from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Correspondences"]


@dataclass(frozen=True)
class Correspondences:
    """Canonical correspondences of B x N posed points: the roots of all queries in one list.

    If a capacity was given, rows beyond the roots belong to no query; they hold zeros and the query B * N.
    """

    canonical: Tensor
    """[M, 3], metres; differentiable in the points, the skinning weights and the bone transforms."""
    query: Tensor
    """[M], index b * N + n of each root's query, ascending."""
    jacobian_inverse: Tensor
    """[M, 3, 3], inverse of dd/dx at each root; has no gradient."""
    batch: int
    """B, number of poses."""
    count: int
    """N, number of queries per pose."""
    total: Tensor
    """[1], number of roots found; more than M only if a capacity cut them."""

    @property
    def pose(self) -> Tensor:
        """[M], index b of each root's pose."""
        return (self.query // max(self.count, 1)).clamp_max(max(self.batch - 1, 0))

    @property
    def found(self) -> Tensor:
        """[B, N], bool, whether each query has a correspondence."""
        mask = torch.zeros(self.batch * self.count + 1, dtype=torch.bool, device=self.query.device)
        mask[self.query] = True
        return mask[:-1].reshape(self.batch, self.count)

    @property
    def counts(self) -> Tensor:
        """[B, N], number of correspondences per query."""
        counts = self.query.new_zeros(self.batch * self.count + 1)
        return counts.index_add(0, self.query, torch.ones_like(self.query))[:-1].reshape(self.batch, self.count)

    def padded(self) -> tuple[Tensor, Tensor]:
        """Return the roots as [B, N, I, 3] and a mask [B, N, I]; I is the largest number of roots of a query, at least 1."""
        total = self.batch * self.count
        real = (self.query < total).nonzero()[:, 0]
        query = self.query[real]
        counts = torch.bincount(query, minlength=total)
        most = max(int(counts.max()), 1) if total else 1
        slot = torch.arange(len(query), device=query.device) - (counts.cumsum(0) - counts)[query]
        at = query * most + slot
        roots = self.canonical.new_zeros(total * most, 3).index_copy(0, at, self.canonical[real])
        mask = torch.zeros(total * most, dtype=torch.bool, device=at.device)
        mask[at] = True
        return roots.reshape(self.batch, self.count, most, 3), mask.reshape(self.batch, self.count, most)

    def maximum(self, values: Tensor, empty: float) -> Tensor:
        """Return the maximum of `values` [M] over the correspondences of each query, [B, N]; `empty` if there are none.

        Source: SNARF Eq. 9.
        """
        out = values.new_full((self.batch * self.count + 1,), empty)
        return out.scatter_reduce(0, self.query, values, "amax", include_self=False)[:-1].reshape(self.batch, self.count)
