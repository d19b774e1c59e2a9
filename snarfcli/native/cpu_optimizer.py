"""The CPU library's step of Adam on tensors."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, byref, c_double, c_float, c_int32, c_int64, c_void_p

import torch
from torch import Tensor

from snarfcli.native.library import native_library

__all__ = ["adam_step"]


class _Parameters(Structure):
    _fields_ = [
        ("values", c_void_p),
        ("gradient", c_void_p),
        ("first", c_void_p),
        ("second", c_void_p),
        ("average", c_void_p),
        ("rows", c_int64),
        ("columns", c_int64),
        ("rate", c_float),
        ("skips_untouched", c_int32),
    ]


class _Adam(Structure):
    _fields_ = [
        ("step", c_int64),
        ("first_decay", c_float),
        ("second_decay", c_float),
        ("epsilon", c_float),
        ("average_decay", c_float),
        ("threads", c_int32),
    ]


def adam_step(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    averages: Sequence[Tensor],
    rates: Sequence[float],
    skips_untouched: Sequence[bool],
    step: int,
    decays: tuple[float, float],
    epsilon: float,
    average_decay: float,
) -> float:
    """Take one step of Adam in place; see `training.adam.adam_step_reference` for arguments and result.

    All tensors are contiguous float32 on the CPU.
    """
    library = native_library()
    assert library is not None
    arrays = (_Parameters * max(len(values), 1))()
    for index, tensors in enumerate(zip(values, gradients, first, second, averages, strict=True)):
        value = tensors[0]
        if any(t.shape != value.shape or t.dtype != torch.float32 or not t.is_contiguous() for t in tensors):
            raise ValueError(f"parameter {index}: wanted contiguous float32 {list(value.shape)} for all of its five arrays")
        rows = len(value) if value.ndim else 1
        pointers = (tensor.data_ptr() for tensor in tensors)
        columns = max(value.numel() // max(rows, 1), 1)
        arrays[index] = _Parameters(*pointers, rows if value.numel() else 0, columns, rates[index], skips_untouched[index])
    settings = _Adam(step, *decays, epsilon, average_decay, torch.get_num_threads())
    magnitude = c_double()
    code = library.snarf_adam_step(arrays, c_int32(len(values)), byref(settings), byref(magnitude))
    if code == 2:
        raise MemoryError("a training step ran out of memory; give fewer points per step")
    if code:
        raise RuntimeError(f"the native library rejected its arguments (code {code})")
    return magnitude.value
