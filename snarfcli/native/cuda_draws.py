"""Random bits on a GPU, by the kernel of csrc/cuda/draws.cu."""

from __future__ import annotations

from ctypes import Structure, c_longlong, c_uint, c_void_p

import torch
from torch import Tensor

from snarfcli.native.cuda_driver import KernelLauncher, gpu

__all__ = ["random_bits", "run_random_bits"]

_THREADS = 256


class _Task(Structure):
    """`DrawTask` of csrc/cuda/draws.cu."""

    _fields_ = [("step", c_void_p), ("bits", c_void_p), ("count", c_longlong), ("key", c_uint)]


def random_bits(step: Tensor, key: int, count: int) -> Tensor:
    """Return 32 random bits for each place of a step; see `draws.random_bits`. Never waits for the device.

    Raises:
        RuntimeError: the kernel cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(step.device):
        return run_random_bits(gpu(torch.empty(0, device=step.device)), step, key, count)


def run_random_bits(launcher: KernelLauncher, step: Tensor, key: int, count: int) -> Tensor:
    """Launch the kernel; arguments and result as in `random_bits`."""
    bits = step.new_empty(count)
    if count:
        threads = launcher.threads(_THREADS)
        task = _Task(step.data_ptr(), bits.data_ptr(), count, key)
        launcher.launch("draws", "draw_bits", (-(-count // threads), 1), threads, task)
    return bits
