"""Arithmetic precision of the networks: context managers that set it and restore it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["PRECISIONS", "matmul_precision", "network_precision"]

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
