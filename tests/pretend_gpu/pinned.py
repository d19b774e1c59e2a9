"""Pinned memory: the tensors of the CPU that were asked to be copied to a GPU without waiting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch._ops import OpOverload

__all__ = ["concerns", "is_pinned", "run"]

_pinned: dict[int, Tensor] = {}  # by the address of their memory, which is theirs as long as they are kept


def concerns(operator: OpOverload, named: dict[str, Any]) -> bool:
    """Return whether an operator makes or asks for pinned memory."""
    return operator._opname in ("_pin_memory", "is_pinned") or bool(named.get("pin_memory"))


def run(operator: OpOverload, arguments: Sequence[Any], named: dict[str, Any]) -> Tensor | bool:
    """Compute such an operator."""
    if operator._opname == "is_pinned":
        return is_pinned(arguments[0])
    if operator._opname == "_pin_memory":
        return _pin(arguments[0].clone())
    return _pin(operator(*arguments, **{name: value for name, value in named.items() if name != "pin_memory"}))


def is_pinned(tensor: Tensor) -> bool:
    """Return whether a tensor of the CPU, or the one that it is a part of, is pinned."""
    return tensor.device.type == "cpu" and tensor.untyped_storage().data_ptr() in _pinned


def _pin(tensor: Tensor) -> Tensor:
    _pinned[tensor.untyped_storage().data_ptr()] = tensor
    return tensor
