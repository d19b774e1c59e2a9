"""Results of a search with a fixed length, independent of the number of roots."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["fit_to_capacity"]


def fit_to_capacity(
    canonical: Tensor, query: Tensor, jacobian_inverse: Tensor, points: Tensor, capacity: int | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut or fill the roots of a search to `capacity` rows; None keeps them as they are.

    Args:
        canonical: [M, 3], metres.
        query: [M], index b * N + n of each root's query.
        jacobian_inverse: [M, 3, 3].
        points: [B, N, 3], the queries. Rows without a root get the query B * N and zeros.
        capacity: length of the results.

    Returns:
        The three arrays, and the number of roots found, [1].
    """
    found = torch.tensor([len(query)], device=query.device)
    if capacity is None:
        return canonical, query, jacobian_inverse, found
    kept = min(capacity, len(query))
    out = (
        points.new_zeros(capacity, 3),
        query.new_full((capacity,), points.shape[0] * points.shape[1]),
        points.new_zeros(capacity, 3, 3),
    )
    for filled, values in zip(out, (canonical, query, jacobian_inverse), strict=True):
        filled[:kept] = values[:kept]
    return *out, found
