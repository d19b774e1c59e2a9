"""The project's own kernels on the pretend device: those for the CPU, on the tensors that its tensors hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch._library.custom_ops import OPDEFS
from torch._ops import OpOverload

from snarfcli.native import backend, cpu, cuda

__all__ = ["default_kernel", "has_cuda_kernel", "install"]

_LAUNCHED = (
    "complete_search",
    "broyden_search",
    "implicit_backward",
)  # functions of native.cuda, also called without an operator


def has_cuda_kernel(operator: OpOverload) -> bool:
    """Return whether an operator of ours has a kernel for CUDA tensors."""
    return "cuda" in OPDEFS[operator._name.removesuffix(".default")]._backend_fns


def default_kernel(operator: OpOverload) -> Callable[..., Any]:
    """Return the kernel of an operator of ours for every device."""
    return OPDEFS[operator._name.removesuffix(".default")]._backend_fns[None]


def install() -> None:
    """Make the functions that launch CUDA kernels run those for the CPU, and say that CUDA kernels are there."""
    for name in _LAUNCHED:
        setattr(cuda, name, _on_cpu(getattr(cpu, name)))
    original = backend.why_no_kernels
    backend.why_no_kernels = lambda device_type: None if device_type == "cuda" else original(device_type)


def _on_cpu(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function on tensors of the device that computes `function` on the tensors which they hold."""

    def run(*arguments: Any) -> Any:
        from pretend_gpu.device import PretendTensor

        def inner(value: Any) -> Any:
            return value.inner if isinstance(value, PretendTensor) else value

        results = function(*map(inner, arguments))
        return tuple(PretendTensor(result) if isinstance(result, Tensor) else result for result in results)

    return torch.no_grad()(run)
