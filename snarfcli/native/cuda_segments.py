"""The distance to the nearest line segment on a GPU, by the kernel of csrc/cuda/segments.cu."""

from __future__ import annotations

from ctypes import Structure, c_int, c_longlong, c_void_p

import torch
from torch import Tensor

from snarfcli.native.cuda_driver import KernelLauncher, gpu

__all__ = ["run_segment_distances", "segment_distances"]

_THREADS = 256


class _Distance(Structure):
    """`SegmentDistance` of csrc/cuda/segments.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("points", "segments", "distance", "direction")),
        ("count", c_longlong),
        ("segment_count", c_int),
    ]


def segment_distances(points: Tensor, segments: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances [N] to the nearest segment and their gradients [N, 3]; see `networks.capsules`.

    Points and segments are float32 on the same GPU. The same input gives the same bits. Runs on PyTorch's current stream, never
    waits for the device, and can be captured in a CUDA graph.

    Raises:
        ValueError: there is no segment.
        RuntimeError: the kernel cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(points.device):
        return run_segment_distances(gpu(points), points, segments)


def run_segment_distances(launcher: KernelLauncher, points: Tensor, segments: Tensor) -> tuple[Tensor, Tensor]:
    """Launch the kernel; arguments and results as in `segment_distances`."""
    if not len(segments):
        raise ValueError("segments: wanted at least one, got none")
    points, segments = points.contiguous(), segments.contiguous()
    distance, direction = points.new_empty(len(points)), torch.empty_like(points)
    if len(points):
        arrays = (tensor.data_ptr() for tensor in (points, segments, distance, direction))
        threads = launcher.threads(_THREADS)
        blocks = -(-len(points) // threads)
        launcher.launch("segments", "measure_distances", (blocks, 1), threads, _Distance(*arrays, len(points), len(segments)))
    return distance, direction
