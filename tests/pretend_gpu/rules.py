"""What an operator of PyTorch means on a GPU: whether the host waits for it, and how many kernels it starts.

The numbers of kernels are estimates from reading PyTorch's CUDA sources. They vary with sizes and versions by a few; they are
for comparing two versions of a program.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload

__all__ = ["bind", "changed_by", "copied_to_device", "is_composite", "kernels_of", "takes_numbers", "why_it_waits"]

_PUTS = ("index_put", "index_put_", "_index_put_impl_", "_unsafe_index_put")
_INDEXED = ("index", "_unsafe_index", *_PUTS)
_TAKES_NUMBERS = ("fill", "fill_", "masked_fill", "masked_fill_", *_PUTS)

_SIZE_FROM_VALUES = (
    "nonzero",
    "masked_select",
    "_unique",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "unique_dim_consecutive",
)
_READS_VALUES = ("_local_scalar_dense", "equal", "allclose", "is_nonzero", "bincount", "histc")
_CHECKS_ERRORS = ("_linalg_check_errors", "_linalg_eigh", "_linalg_svd", "linalg_eig", "linalg_lstsq")
_WAITS = _SIZE_FROM_VALUES + _READS_VALUES + _CHECKS_ERRORS

_OF_OURS = {"complete_search": 11, "broyden_search": 6, "implicit_backward": 3, "encode_backward": 2, "variation": 3}
_KERNELS = {
    "index_put": 7, "index_put_": 6, "_index_put_impl_": 6, "nonzero": 4, "masked_select": 6, "_unique2": 8, "argsort": 3,
    "sort": 3, "cumsum": 2, "bincount": 5, "repeat_interleave": 3, "scatter_reduce": 2, "index_add": 2, "index_copy": 2,
    "scatter": 2, "embedding_dense_backward": 4, "linalg_inv_ex": 6,
}  # fmt: skip
_NO_KERNEL = ("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "_unsafe_view", "_local_scalar_dense",
              "is_same_size")  # fmt: skip
_TENSORS_PER_KERNEL = 60  # of the operators that take lists


def bind(operator: OpOverload, arguments: Sequence[Any], named: dict[str, Any]) -> dict[str, Any]:
    """Return all arguments of a call by their names in the schema, with the defaults of those that are missing."""
    names, defaults = _signature(operator)
    return defaults | dict(zip(names, arguments, strict=False)) | named


@cache
def _signature(operator: OpOverload) -> tuple[list[str], dict[str, Any]]:
    schema = operator._schema.arguments
    return [one.name for one in schema], {one.name: one.default_value for one in schema if one.has_default_value()}


def kernels_of(operator: OpOverload, values: dict[str, Any], results: Sequence[Tensor]) -> int:
    """Return the estimated number of kernels that an operator on a GPU starts; `values` as from `bind`."""
    name = operator._opname
    if operator.namespace == "snarf":
        return _OF_OURS.get(name, 1)
    if name in _NO_KERNEL or _is_view(operator) or (results and not any(result.numel() for result in results)):
        return 0
    if name.startswith("_foreach"):
        return -(-len(next(iter(values.values()))) // _TENSORS_PER_KERNEL)
    return 1 if _fills_a_mask(name, values) else _KERNELS.get(name, 1)


def why_it_waits(operator: OpOverload, values: dict[str, Any]) -> str | None:
    """Return what the host waits for in an operator on tensors of a GPU, or None if it does not wait."""
    name = operator._opname
    if operator.namespace == "snarf":
        return f"{name} without a capacity" if values.get("capacity", 0) is None else None
    if name in _WAITS:
        return name
    if name in _INDEXED and any(map(_is_mask, _indices(values))) and not _fills_a_mask(name, values):
        return f"{name} by a mask"
    if name == "repeat_interleave" and values["output_size"] is None:
        return "repeat_interleave without output_size"
    return f"{name} that checks for errors" if values.get("check_errors") else None


def copied_to_device(operator: OpOverload, values: dict[str, Any]) -> list[Tensor]:
    """Return the tensors of the CPU that an operator itself copies to the GPU: indices, and a number for places at indices."""
    name = operator._opname
    if name not in _INDEXED or values["self"].device.type == "cpu":
        return []
    copied = [index for index in _indices(values) if index.device.type == "cpu"]
    puts_number = name in _PUTS and _is_number(values["values"]) and not _fills_a_mask(name, values)
    return [*copied, values["values"]] if puts_number else copied


def changed_by(operator: OpOverload, values: dict[str, Any]) -> list[Any]:
    """Return the arguments that an operator changes in place."""
    return [values[name] for name in _changed_names(operator)]


@cache
def _changed_names(operator: OpOverload) -> list[str]:
    return [one.name for one in operator._schema.arguments if one.alias_info is not None and one.alias_info.is_write]


@cache
def is_composite(operator: OpOverload) -> bool:
    """Return whether an operator is computed by others, in the forward and in the backward pass."""
    return operator.has_kernel_for_dispatch_key(torch._C.DispatchKey.CompositeImplicitAutograd)


@cache
def takes_numbers(operator: OpOverload) -> bool:
    """Return whether an operator on tensors of a GPU takes tensors of no dimension from the CPU, as numbers."""
    return torch.Tag.pointwise in operator.tags or operator._opname in _TAKES_NUMBERS


@cache
def _is_view(operator: OpOverload) -> bool:
    return any(one.alias_info is not None and not one.alias_info.is_write for one in operator._schema.returns)


def _indices(values: dict[str, Any]) -> list[Tensor]:
    return [index for index in values["indices"] if index is not None]


def _is_mask(index: Tensor) -> bool:
    return index.dtype in (torch.bool, torch.uint8)


def _is_number(value: Tensor) -> bool:
    return value.dim() == 0 and value.device.type == "cpu"


def _fills_a_mask(name: str, values: dict[str, Any]) -> bool:
    """Return whether an operator only sets the places of one mask to a number of the host, for which it needs no indices."""
    if name not in _PUTS or values["accumulate"] or not _is_number(values["values"]):
        return False
    indices = _indices(values)
    return len(indices) == 1 and _is_mask(indices[0]) and indices[0].device == values["self"].device
