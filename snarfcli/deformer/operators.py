"""Shared by the operators of the searches and of their gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor
from torch._library.custom_ops import CustomOpDef

from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.native.backend import choose_backend

__all__ = ["grid_of", "register_native"]


def register_native(operator: CustomOpDef, device_type: str, native: Callable, reference: Callable) -> None:
    """Register `native` for one type of device, replaced by `reference` depending on the last argument, `backend`."""

    @operator.register_kernel(device_type)
    def kernel(*arguments):
        *given, backend = arguments
        return (native if choose_backend(backend, given[0].device) == "native" else reference)(*given)


def grid_of(lower: Tensor, upper: Tensor, shape: Sequence[int]) -> tuple[CanonicalGrid, tuple[int, int, int]]:
    """Return the box and the nodes (D, H, W) as the readable versions take them."""
    return CanonicalGrid(lower, upper, checked=True), (shape[0], shape[1], shape[2])
