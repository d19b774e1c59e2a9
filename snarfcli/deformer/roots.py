"""Shared by the searches: the set of roots that they return, and small linear algebra."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.field_docs import documented

__all__ = ["Roots", "drop_duplicates", "invert_3x3", "is_costly_to_read"]


@documented
@dataclass
class Roots:
    """Roots of d(x) = x' for the queries of several poses, before gradients are attached."""

    canonical: Tensor
    """[M, 3], metres."""
    query: Tensor
    """[M], index b * N + n of each root's query, ascending."""
    jacobian_inverse: Tensor
    """[M, 3, 3], inverse of dd/dx at the root."""

    @classmethod
    def concatenate(cls, parts: list[Roots]) -> Roots:
        """Join the roots of consecutive queries."""
        fields = ("canonical", "query", "jacobian_inverse")
        return cls(*(torch.cat([getattr(part, field) for part in parts]) for field in fields))

    def take(self, index: Tensor) -> Roots:
        """Return the roots at `index` [K]."""
        return Roots(*(field.index_select(0, index) for field in vars(self).values()))


def invert_3x3(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return inverses [M, 3, 3] and determinants [M] of 3x3 matrices; a singular matrix gives infinities or NaN.

    Written out: many times faster than a batched LU factorisation, and never in reduced precision.
    """
    a, b, c, d, e, f, g, h, i = matrix.reshape(-1, 9).unbind(1)
    first, second, third = e * i - f * h, f * g - d * i, d * h - e * g
    determinant = a * first + b * second + c * third
    adjugate = [first, c * h - b * i, b * f - c * e, second, a * i - c * g, c * d - a * f, third, b * g - a * h, a * e - b * d]
    return (torch.stack(adjugate, 1) / determinant[:, None]).reshape(-1, 3, 3), determinant


def is_costly_to_read(tensor: Tensor) -> bool:
    """Return whether reading the values of a tensor would wait for a GPU, or break a graph that is compiled."""
    return tensor.is_cuda or torch.compiler.is_compiling()


def drop_duplicates(roots: Roots, distance: float, *, by_orientation: bool = False) -> Roots:
    """Sort roots by query and keep one of those of the same query that lie closer together than `distance`, metres.

    Neighbouring cells both report a root on their common face, and several starts reach the same root.

    Args:
        roots: in any order.
        distance: metres.
        by_orientation: keep both of two close roots if the determinants of their Jacobians differ in sign.
    """
    order = torch.argsort(roots.query, stable=True)
    roots = roots.take(order)
    keep = torch.ones(len(order), dtype=torch.bool, device=order.device)
    kind = invert_3x3(roots.jacobian_inverse)[1] > 0 if by_orientation else keep.clone()
    # Roots of one query stand side by side, so comparing each with the k-th before it, for growing k, meets all pairs.
    for k in range(1, len(order)):
        same = roots.query[k:] == roots.query[:-k]
        if not bool(same.any()):
            break
        close = (roots.canonical[k:] - roots.canonical[:-k]).norm(dim=1) < distance
        keep[k:] &= ~(same & close & (kind[k:] == kind[:-k]) & keep[:-k])
    return roots.take(keep.nonzero()[:, 0])
