"""The project's own kernels on the pretend device.

An operator with a CUDA kernel runs its kernel for the CPU on the tensors that the device's tensors hold, which is fast. With
SNARF_PRETEND_GPU_EMULATED=1 it runs as on a GPU, up to the launch: its kernels are those of csrc/cuda, compiled as C++. So are
always kernels that are launched without an operator.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from ctypes import Structure
from functools import cache, partial
from typing import Any

import torch
from cuda_emulation import EmulatedGpu
from pretend_gpu import graphs
from pretend_gpu.seen import current_line, note_kernels
from torch import Tensor
from torch._library.custom_ops import OPDEFS
from torch._ops import OpOverload

from snarfcli.native import backend, cpu, cuda_driver

__all__ = ["install", "kernel_on_device"]

_EMULATED = os.environ.get("SNARF_PRETEND_GPU_EMULATED") == "1"
_CALLED_DIRECTLY = {"implicit_backward": 3}  # functions of native.cuda, and their numbers of kernels


class _Launcher(EmulatedGpu):
    """Runs kernels of csrc/cuda, compiled as C++ in seconds, in the memory of the tensors that the device's tensors hold."""

    def launch(
        self, source: str, kernel: str, blocks: tuple[int, int], threads: int, arguments: Structure, *rest: Any, **named: Any
    ) -> None:
        given = type(arguments).from_buffer_copy(arguments)  # a graph keeps them as they are now
        run = partial(super().launch, source, kernel, blocks, threads, given, *rest, **named)
        run()
        line = f"{kernel}: {current_line()}"
        note_kernels(line, 1)
        graphs.record(run, (), (), 1, line)


def kernel_on_device(operator: OpOverload, values: dict[str, Any]) -> Callable[..., Any] | None:
    """Return the function that computes an operator of ours from tensors of the device; None to run its kernel for the CPU.

    The readable versions have no kernels: they run on the device.
    """
    kernels = OPDEFS[operator._name.removesuffix(".default")]._backend_fns
    if "cuda" not in kernels:
        return kernels[None]
    return kernels["cuda"] if _EMULATED or values.get("backend") == "reference" else None


def install() -> None:
    """Take the place of the GPU in what launches kernels, and say that there are kernels for it."""
    launcher = cache(_Launcher)
    cuda_driver.gpu = lambda tensor: launcher(tensor.dtype)
    from snarfcli.native import cuda  # which imports `gpu`

    if not _EMULATED:
        for name, count in _CALLED_DIRECTLY.items():
            setattr(cuda, name, _on_cpu(name, getattr(cpu, name), count))
    original = backend.why_no_kernels
    backend.why_no_kernels = lambda device: None if torch.device(device).type == "cuda" else original(device)


def _on_cpu(name: str, function: Callable[..., Any], launches: int) -> Callable[..., Any]:
    """Return a function on tensors of the device that computes `function` on the tensors which they hold."""
    from pretend_gpu.device import PretendTensor

    @torch.no_grad()
    def run(*arguments: Any) -> Any:
        given = [value.inner if isinstance(value, PretendTensor) else value for value in arguments]
        results, line = function(*given), f"{name}: {current_line()}"
        note_kernels(line, launches)
        graphs.record(partial(function, *given), given, results, launches, line)
        return tuple(PretendTensor(result) if isinstance(result, Tensor) else result for result in results)

    return run
