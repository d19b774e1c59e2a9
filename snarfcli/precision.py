"""Arithmetic precision of the networks: context managers that set it and restore it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, TypeVar

import torch

__all__ = ["PRECISIONS", "matmul_precision", "network_precision", "without_autocast"]

Function = TypeVar("Function", bound=Callable[..., Any])

PRECISIONS = ("highest", "high", "medium", "bfloat16")
"""Names of the precisions of a network, see `network_precision`."""


@contextmanager
def matmul_precision(name: str) -> Iterator[None]:
    """Set the precision of float32 matrix products inside the block: highest, high or medium.

    The correspondence search always uses "highest": the error of TF32 is half a millimetre at one metre.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def without_autocast(function: Function) -> Function:
    """Run a function in the precision of its arguments, also under autocast, which would round poses by millimetres."""

    @wraps(function)
    def exact(*arguments: Any, **keywords: Any) -> Any:
        # of all types of device, since the arguments may be anywhere
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*arguments, **keywords)

    return exact  # pyright: ignore[reportReturnType]


@contextmanager
def network_precision(name: str, device: torch.device) -> Iterator[None]:
    """Set the precision of a network's layers inside the block, one of `PRECISIONS`.

    On a CPU "medium" computes matrix products with oneDNN: twice as fast where MKL is slow, and exact unless the processor has
    AMX or bfloat16 matrix units, which round to bfloat16. On a GPU "high" and "medium" allow TF32. "bfloat16" runs whole layers
    in mixed precision.
    """
    mixed = name == "bfloat16"
    with matmul_precision("medium" if mixed else name), torch.autocast(device.type, torch.bfloat16, enabled=mixed):
        yield
