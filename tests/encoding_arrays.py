"""Arguments of an encoding for tests of its kernels on any device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from snarfcli.shape.features import FeatureGrids

__all__ = ["encoding_arrays"]

_LOWER, _UPPER = torch.tensor([-1.0, -1.2, -0.3]), torch.tensor([1.0, 0.9, 0.4])


def encoding_arrays(
    count: int,
    features: int = 4,
    cells: Sequence[float] = (0.3, 0.11),
    frequencies: Sequence[float] = (2.0, 16.0),
    dtype: torch.dtype = torch.float32,
) -> tuple[Any, ...]:
    """Return the arguments of `encode`: grids that are covered in part, and points inside and a little outside of the box."""
    generator = torch.Generator().manual_seed(0)
    grids = FeatureGrids(_LOWER, _UPPER, cells, features)
    grids.cover(torch.rand(4, 9, 8, generator=generator) > 0.85)
    points = (torch.rand(count, 3, generator=generator) * (_UPPER - _LOWER) * 1.1 + _LOWER - 0.05).to(dtype)
    table = torch.randn(len(grids.table), features, generator=generator).to(dtype)
    return points, torch.tensor(frequencies, dtype=dtype), table, grids.rows, grids.nodes, grids.boxes
