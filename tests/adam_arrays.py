"""Made-up parameters with what a step of Adam reads and writes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["DECAYS", "EPSILON", "AdamArrays", "adam_arrays", "are_equal", "new_gradients"]

DECAYS = (0.9, 0.999)
EPSILON = 1e-8

AdamArrays = tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor], list[Tensor]]
"""Values, gradients, both moments and averages of some parameters."""


def adam_arrays(shapes: Sequence[Sequence[int]], seed: int, dtype: torch.dtype = torch.float32) -> AdamArrays:
    """Return arrays of the shapes given.

    A tenth of the rows of arrays with more than 300 rows have gradients, some of which have zeros in them.
    """
    generator = torch.Generator().manual_seed(seed)
    values, gradients, first, second, averages = (
        [torch.randn(shape, generator=generator).to(dtype) for shape in shapes] for _ in range(5)
    )
    _clear_rows(gradients, generator)
    return values, gradients, first, [square.abs() for square in second], averages


def new_gradients(arrays: AdamArrays, seed: int) -> None:
    """Fill the gradients with other numbers, for the next step."""
    generator = torch.Generator().manual_seed(seed)
    for gradient in arrays[1]:
        gradient.copy_(torch.randn(gradient.shape, generator=generator))
    _clear_rows(arrays[1], generator)


def are_equal(some: Sequence[Sequence[Tensor]], others: Sequence[Sequence[Tensor]]) -> bool:
    """Return whether arrays have the same bits."""
    return all(torch.equal(a, b) for a, b in zip(itertools.chain(*some), itertools.chain(*others), strict=True))


def _clear_rows(gradients: Sequence[Tensor], generator: torch.Generator) -> None:
    for gradient in gradients:
        if gradient.ndim > 1 and len(gradient) > 300:
            gradient[torch.rand(len(gradient), generator=generator) > 0.1] = 0
            gradient[::2, 0] = 0
