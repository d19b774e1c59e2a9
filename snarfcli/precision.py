"""Arithmetic precision of the networks, set where it may be lowered and restored afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["PRECISIONS", "matmul_precision", "network_precision"]

PRECISIONS = ("highest", "high", "medium", "bfloat16")


@contextmanager
def matmul_precision(name: str) -> Iterator[None]:
    """Let float32 matrix products run at `name` inside the block, whatever the caller has set: highest, high or medium.

    The correspondence search always asks for "highest": TF32 would be half a millimetre at one metre.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def network_precision(name: str, device: torch.device) -> Iterator[None]:
    """Let a network's layers run at one of `PRECISIONS` inside the block.

    On a CPU "medium" hands matrix products to oneDNN: twice as fast where MKL is slow, and exact unless the processor has AMX
    or bfloat16 matrix units, which then round to bfloat16. On a GPU "high" and "medium" allow TF32. "bfloat16" runs whole
    layers in mixed precision.
    """
    mixed = name == "bfloat16"
    with matmul_precision("medium" if mixed else name), torch.autocast(device.type, torch.bfloat16, enabled=mixed):
        yield
