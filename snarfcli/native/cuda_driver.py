"""Runs compiled kernels on a GPU through the CUDA driver, on PyTorch's current stream."""

from __future__ import annotations

import ctypes
import sys
import threading
from ctypes import Structure, byref, c_char_p, c_int, c_uint, c_void_p
from functools import cache
from typing import Protocol

import torch

from snarfcli.native.cuda_compile import architecture_for, load_kernels

__all__ = ["Gpu", "Launcher", "gpu"]


class Launcher(Protocol):
    """What runs kernels: a GPU, or the tests' emulation of one."""

    def threads(self, most: int) -> int:
        """Return how many threads a block gets, at most `most`."""

    def launch(self, source: str, kernel: str, blocks: tuple[int, int], threads: int, arguments: Structure) -> None:
        """Run a kernel of csrc/cuda/<source>.cu with one structure as its argument, after everything launched before."""


class Gpu:
    """One device, and the kernels for one type of numbers that are loaded on it."""

    def __init__(self, device: torch.device, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.device = device
        self._lock = threading.Lock()
        self._functions: dict[tuple[str, str], c_void_p] = {}
        self._modules: dict[str, c_void_p] = {}
        self._architecture = architecture_for(torch.cuda.get_device_capability(device))
        # PyTorch's own context: kernels and memory belong to it.
        handle, self._context = c_int(), c_void_p()
        _check(_driver().cuInit(0))
        _check(_driver().cuDeviceGet(byref(handle), device.index))
        _check(_driver().cuDevicePrimaryCtxRetain(byref(self._context), handle))

    def threads(self, most: int) -> int:
        return most

    def launch(self, source: str, kernel: str, blocks: tuple[int, int], threads: int, arguments: Structure) -> None:
        function = self._function(source, kernel)
        stream = c_void_p(torch.cuda.current_stream(self.device).cuda_stream)
        parameters = (c_void_p * 1)(ctypes.addressof(arguments))
        size = (c_uint(blocks[0]), c_uint(blocks[1]), c_uint(1), c_uint(threads), c_uint(1), c_uint(1))
        _check(_driver().cuLaunchKernel(function, *size, c_uint(0), stream, parameters, None))

    def _function(self, source: str, kernel: str) -> c_void_p:
        # A thread of autograd may not have a context yet; inside torch.cuda.device() this is the one that it would get.
        _check(_driver().cuCtxSetCurrent(self._context))
        function = self._functions.get((source, kernel))
        if function is None:
            with self._lock:
                if source not in self._modules:
                    code, module = load_kernels(source, self.dtype, self._architecture), c_void_p()
                    _check(_driver().cuModuleLoadData(byref(module), code))
                    self._modules[source] = module
                function = c_void_p()
                _check(_driver().cuModuleGetFunction(byref(function), self._modules[source], kernel.encode()))
                self._functions[source, kernel] = function
        return function


def gpu(tensor: torch.Tensor) -> Gpu:
    """Return the launcher for the device and the type of `tensor`."""
    return _gpu(tensor.device.index, tensor.dtype)


@cache
def _gpu(index: int, dtype: torch.dtype) -> Gpu:
    return Gpu(torch.device("cuda", index), dtype)


@cache
def _driver() -> ctypes.CDLL:
    return ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")


def _check(code: int) -> None:
    if code:
        text = c_char_p()
        _driver().cuGetErrorString(code, byref(text))
        raise RuntimeError(f"CUDA: {text.value.decode() if text.value else f'error {code}'}")
