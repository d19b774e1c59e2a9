"""Run compiled kernels on a GPU through the CUDA driver, on PyTorch's current stream.

The driver is called through ctypes and not through the package cuda.bindings: that would be one more dependency, tied to a CUDA
version, and a dozen functions of the driver are enough.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import Structure, byref, c_char_p, c_int, c_uint, c_void_p
from functools import cache
from pathlib import Path
from typing import Protocol

import torch

from snarfcli.devices import cuda_driver
from snarfcli.native.cuda_compile import architecture_for, load_kernels

__all__ = ["Gpu", "KernelLauncher", "gpu", "try_kernels"]

_SMALLEST = ("gather", "collect_roots")  # source and kernel; compiled in a tenth of a second
_MOST_SHARED_BYTES = 97  # CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN
_MULTIPROCESSORS = 16  # CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT
_DYNAMIC_SHARED_BYTES = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
_ALWAYS_GRANTED_BYTES = 48 * 1024
_RELAXED = 2  # CU_STREAM_CAPTURE_MODE_RELAXED


class KernelLauncher(Protocol):
    """Interface that runs kernels: implemented by a GPU, and by the tests' emulation of one."""

    capability: tuple[int, int]
    """Compute capability, such as (9, 0)."""
    most_shared_bytes: int
    """Maximum shared memory of a block."""
    multiprocessors: int
    """Number of multiprocessors."""

    def threads(self, most: int) -> int:
        """Return the number of threads per block, at most `most`."""
        ...

    def launch(
        self,
        source: str | Path,
        kernel: str,
        blocks: tuple[int, int],
        threads: int,
        arguments: Structure,
        shared_bytes: int = 0,
    ) -> None:
        """Run a kernel with one structure as its argument, after all earlier launches.

        Args:
            source: file in csrc/cuda without its ending, or the path of a file elsewhere.
            kernel: name of the function.
            blocks, threads: numbers of blocks, and of threads per block.
            arguments: the structure.
            shared_bytes: dynamic shared memory of a block, at most `most_shared_bytes`.
        """


class Gpu:
    """One device with the loaded kernels for one dtype."""

    def __init__(self, device: torch.device, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.device = device
        self._lock = threading.Lock()
        self._functions: dict[tuple[str | Path, str], c_void_p] = {}
        self._modules: dict[str | Path, c_void_p] = {}
        self._granted: dict[tuple[str | Path, str], int] = {}  # dynamic shared memory of each kernel
        self.capability = torch.cuda.get_device_capability(device)
        self._architecture = architecture_for(self.capability)
        # PyTorch's own context: kernels and memory belong to it.
        handle, self._context = c_int(), c_void_p()
        _check(cuda_driver().cuInit(0))
        _check(cuda_driver().cuDeviceGet(byref(handle), device.index))
        _check(cuda_driver().cuDevicePrimaryCtxRetain(byref(self._context), handle))
        self.most_shared_bytes = _attribute(handle, _MOST_SHARED_BYTES)
        self.multiprocessors = _attribute(handle, _MULTIPROCESSORS)

    def threads(self, most: int) -> int:
        return most

    def launch(
        self,
        source: str | Path,
        kernel: str,
        blocks: tuple[int, int],
        threads: int,
        arguments: Structure,
        shared_bytes: int = 0,
    ) -> None:
        function = self.load(source, kernel)
        with self._lock:  # no other thread may lower what this launch is granted
            if shared_bytes > self._granted.get((source, kernel), _ALWAYS_GRANTED_BYTES):
                _check(cuda_driver().cuFuncSetAttribute(function, c_int(_DYNAMIC_SHARED_BYTES), c_int(shared_bytes)))
                self._granted[source, kernel] = shared_bytes
        stream = c_void_p(torch.cuda.current_stream(self.device).cuda_stream)
        parameters = (c_void_p * 1)(ctypes.addressof(arguments))
        size = (c_uint(blocks[0]), c_uint(blocks[1]), c_uint(1), c_uint(threads), c_uint(1), c_uint(1))
        _check(cuda_driver().cuLaunchKernel(function, *size, c_uint(shared_bytes), stream, parameters, None))

    def load(self, source: str | Path, kernel: str) -> c_void_p:
        """Return the handle of a kernel in `source`, as for `launch`, compiled and loaded on first use."""
        # A thread of autograd may have no context yet; inside torch.cuda.device() it would get this one.
        _check(cuda_driver().cuCtxSetCurrent(self._context))
        function = self._functions.get((source, kernel))
        if function is None:
            with self._lock, _allowed_in_capture():
                if source not in self._modules:
                    code, module = load_kernels(source, self.dtype, self._architecture), c_void_p()
                    _check(cuda_driver().cuModuleLoadData(byref(module), code))
                    self._modules[source] = module
                function = c_void_p()
                _check(cuda_driver().cuModuleGetFunction(byref(function), self._modules[source], kernel.encode()))
                self._functions[source, kernel] = function
        return function


def gpu(tensor: torch.Tensor) -> Gpu:
    """Return the launcher for the device and dtype of `tensor`."""
    return _gpu(tensor.device.index, tensor.dtype)


def try_kernels(device: torch.device) -> None:
    """Compile and load the smallest kernel for a GPU, to see whether kernels can run there.

    Raises:
        RuntimeError: NVRTC is missing, does not support the GPU or cannot compile; or the driver or the GPU cannot load it.
        OSError: the driver is not installed.
    """
    index = torch.cuda.current_device() if device.index is None else device.index
    with torch.cuda.device(index):
        _gpu(index, torch.float32).load(*_SMALLEST)


@cache
def _gpu(index: int, dtype: torch.dtype) -> Gpu:
    return Gpu(torch.device("cuda", index), dtype)


@contextmanager
def _allowed_in_capture() -> Iterator[None]:
    """Let this thread load kernels while a CUDA graph is captured, which drivers since CUDA 12.3 can; older ones refuse."""
    mode = c_int(_RELAXED)
    _check(cuda_driver().cuThreadExchangeStreamCaptureMode(byref(mode)))  # `mode` becomes the one before
    try:
        yield
    finally:
        _check(cuda_driver().cuThreadExchangeStreamCaptureMode(byref(mode)))


def _attribute(device: c_int, name: int) -> int:
    value = c_int()
    _check(cuda_driver().cuDeviceGetAttribute(byref(value), c_int(name), device))
    return value.value


def _check(code: int) -> None:
    if code:
        text = c_char_p()
        cuda_driver().cuGetErrorString(code, byref(text))
        raise RuntimeError(f"CUDA: {text.value.decode() if text.value else f'error {code}'}")
