"""Small tensors of fixed numbers, kept on each device, since copying them to a GPU in every call would make the host wait."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch._subclasses import FakeTensor  # no public name; what traces without values must not be kept

__all__ = ["constant"]

_kept: dict[tuple[object, ...], Tensor] = {}


def constant(values: Sequence[float], device: torch.device, dtype: torch.dtype = torch.int64) -> Tensor:
    """Return a tensor of numbers on a device, not to be changed.

    On a CPU, and while PyTorch traces, it is new in every call. On another device it is kept by its numbers, not in a module:
    nothing is stale after `.to()`, in deep copies or in pickles. It is never dropped, as captured CUDA graphs read it.
    """
    if device.type in ("cpu", "meta") or torch.compiler.is_compiling():
        return torch.tensor(values, dtype=dtype, device=device)
    key = (tuple(values), device.type, device.index, dtype)
    if key not in _kept:
        with torch.inference_mode(False):  # in it, autograd could not save the tensor later
            new = torch.tensor(values, dtype=dtype, device=device)
        if isinstance(new, FakeTensor):
            return new
        _kept[key] = new
    return _kept[key]
