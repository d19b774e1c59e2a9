"""Values between the nodes of a grid on a GPU, by the kernel of csrc/cuda/interpolate.cu."""

from __future__ import annotations

from ctypes import Structure, c_int, c_longlong, c_void_p

import torch
from torch import Tensor

from snarfcli.native.cuda_driver import KernelLauncher, gpu

__all__ = ["interpolate", "run_interpolate"]

_THREADS = 256


class _Interpolation(Structure):
    """`Interpolation` of csrc/cuda/interpolate.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("values", "points", "lower", "upper", "out")),
        ("count", c_longlong),
        ("channels", c_int),
        ("nodes", c_int * 3),
    ]


def interpolate(values: Tensor, points: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Interpolate node values [D, H, W, C] at points [N, 3], [N, C]; see `trilinear.interpolate`.

    All arrays are float32 or float64, of one type, and on the same GPU. The same input gives the same bits. Runs on PyTorch's
    current stream, never waits for the device, and can be captured in a CUDA graph.

    Raises:
        ValueError: fewer than 2 nodes along a side.
        RuntimeError: the kernel cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(values.device):
        return run_interpolate(gpu(values), values, points, lower, upper)


def run_interpolate(launcher: KernelLauncher, values: Tensor, points: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Launch the kernel; arguments and result as in `interpolate`."""
    if min(values.shape[:3]) < 2:
        raise ValueError(f"values: wanted at least 2 nodes along each side, got {list(values.shape[:3])}")
    given = [tensor.contiguous() for tensor in (values, points, lower, upper)]
    out = values.new_empty(len(points), values.shape[3])
    if out.numel():
        threads = launcher.threads(_THREADS)
        arrays = (tensor.data_ptr() for tensor in (*given, out))
        arguments = _Interpolation(*arrays, len(points), values.shape[3], (*values.shape[2::-1],))
        launcher.launch("interpolate", "interpolate_values", (-(-out.numel() // threads), 1), threads, arguments)
    return out
