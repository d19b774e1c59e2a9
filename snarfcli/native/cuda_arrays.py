"""What several kernels of csrc/cuda take as arguments: aligned arrays, and the levels of feature grids."""

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


def feature_levels(most: int, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]) -> Array[FeatureLevel]:
    """Return room for `most` levels, of which the first describe feature grids; arguments as those of `networks.encode`.

    `rows` is contiguous int32, and has to outlive the kernel's launch.
    """
    levels, place = (FeatureLevel * most)(), rows.data_ptr()
    for level in range(len(nodes) // 3):
        along, box = nodes[3 * level : 3 * level + 3], boxes[6 * level : 6 * level + 6]
        per_metre = [1 / c_float(size).value for size in box[3:]]
        levels[level] = FeatureLevel((*box[:3],), (*per_metre,), (*along,), place, len(table))
        place += rows.element_size() * math.prod(along)
    return levels


def aligned(tensor: Tensor) -> Tensor:
    """Return the tensor contiguous and aligned to 16 bytes, for kernels that read as many at once."""
    tensor = tensor.contiguous()
    return tensor if tensor.data_ptr() % 16 == 0 else tensor.clone()
