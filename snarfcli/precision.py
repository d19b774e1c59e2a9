"""Arithmetic precision of matrix products, set where it may be lowered and restored afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["PRECISIONS", "matmul_precision"]

PRECISIONS = ("highest", "high", "medium")


@contextmanager
def matmul_precision(name: str) -> Iterator[None]:
    """Let float32 matrix products run at `name` ("highest", "high" or "medium") inside the block.

    For networks only, never for the correspondence search. On a CPU "medium" hands the products to oneDNN: twice as fast
    where MKL is slow, and exact unless the processor has AMX or bfloat16 matrix units, which then round to bfloat16. On a
    GPU "high" and "medium" allow TF32.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
