"""How the kernels of csrc/cuda get tensors and feature grids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from ctypes import Array, Structure, c_float, c_int, c_uint, c_void_p

from torch import Tensor

__all__ = ["FeatureLevel", "aligned", "feature_levels"]


class FeatureLevel(Structure):
    """`FeatureLevel` of csrc/include/snarf/places.h."""

    _fields_ = [
        ("lower", c_float * 3),
        ("per_metre", c_float * 3),
        ("nodes", c_int * 3),
        ("rows", c_void_p),
        ("row_count", c_uint),
    ]


def feature_levels(
    room: int, rows: Tensor, row_count: int, nodes: Sequence[int], boxes: Sequence[float]
) -> Array[FeatureLevel]:
    """Return the structures of feature grids.

    Args:
        room: their number, at least that of the levels; the others are zero.
        rows: contiguous; must outlive the kernel.
        row_count: number of rows of the table.
        nodes, boxes: as in `networks.encode`.
    """
    levels, place = (FeatureLevel * room)(), rows.data_ptr()
    for level in range(len(nodes) // 3):
        shape, box = nodes[3 * level : 3 * level + 3], boxes[6 * level : 6 * level + 6]
        per_metre = [1 / c_float(size).value for size in box[3:]]
        levels[level] = FeatureLevel((*box[:3],), (*per_metre,), (*shape,), place, row_count)
        place += rows.element_size() * math.prod(shape)
    return levels


def aligned(tensor: Tensor) -> Tensor:
    """Return the tensor contiguous and aligned to 16 bytes, which kernels read at once."""
    tensor = tensor.contiguous()
    return tensor if tensor.data_ptr() % 16 == 0 else tensor.clone()
