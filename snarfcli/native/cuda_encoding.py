"""The encoding of points on a GPU, by the kernels of csrc/cuda/encoding.cu."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, c_int, c_longlong, c_void_p
from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.native.cuda_arrays import FeatureLevel, aligned, feature_levels
from snarfcli.native.cuda_driver import KernelLauncher, gpu

__all__ = ["MAX_LEVELS", "encode", "encode_backward", "run_encode", "run_encode_backward"]

MAX_LEVELS = 32
"""Maximum number of levels of feature grids."""

_THREADS = 256


class _Encoding(Structure):
    """`Encoding` of csrc/cuda/encoding.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("points", "frequencies", "table", "out", "v_out", "v_points", "v_table")),
        ("count", c_longlong),
        ("levels", FeatureLevel * MAX_LEVELS),
        *((name, c_int) for name in ("frequency_count", "level_count", "features")),
    ]


def encode(
    points: Tensor, frequencies: Tensor, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]
) -> Tensor:
    """Encode points; see `networks.encode` for arguments and result. The same input gives the same bits.

    All arrays are float32, but `rows`, and on the same GPU. Runs on PyTorch's current stream, never waits for the device, and
    can be captured in a CUDA graph.

    Raises:
        ValueError: more than `MAX_LEVELS` levels, or one with fewer than 2 nodes along a side.
        RuntimeError: the kernels cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(points.device):
        return run_encode(gpu(points), points, frequencies, table, rows, nodes, boxes)


def encode_backward(
    gradient: Tensor,
    encoded: Tensor,
    points: Tensor,
    frequencies: Tensor,
    table: Tensor,
    rows: Tensor,
    nodes: Sequence[int],
    boxes: Sequence[float],
    wants_points: bool,
    wants_table: bool,
) -> tuple[Tensor, Tensor]:
    """Return the gradients by the points and by the features; see `networks.encode_backward`. Errors as in `encode`.

    The first is deterministic. The second is summed by atomics in an order that varies, and so do its last bits.
    """
    with torch.cuda.device(points.device):
        given, wants = (points, frequencies, table, rows, nodes, boxes), (wants_points, wants_table)
        return run_encode_backward(gpu(points), gradient, encoded, *given, *wants)


@dataclass
class _Points:
    """The arguments of both directions, of which the kernels read what `struct` points to."""

    points: Tensor
    frequencies: Tensor
    table: Tensor
    rows: Tensor
    nodes: Sequence[int]
    boxes: Sequence[float]

    def __post_init__(self) -> None:
        self.points, self.frequencies = self.points.contiguous(), self.frequencies.contiguous()
        self.table, self.rows = aligned(self.table), self.rows.contiguous()
        self.levels = len(self.nodes) // 3
        if self.levels > MAX_LEVELS or min(self.nodes, default=2) < 2:
            raise ValueError(f"nodes: wanted at most {MAX_LEVELS} levels of 2 nodes or more along a side, got {self.nodes}")
        self.size = 3 + 6 * len(self.frequencies) + self.levels * self.table.shape[1]
        self.struct = _Encoding(
            points=self.points.data_ptr(),
            frequencies=self.frequencies.data_ptr(),
            table=self.table.data_ptr(),
            count=len(self.points),
            levels=feature_levels(MAX_LEVELS, self.table, self.rows, self.nodes, self.boxes),
            frequency_count=len(self.frequencies),
            level_count=self.levels,
            features=self.table.shape[1],
        )


def run_encode(
    launcher: KernelLauncher,
    points: Tensor,
    frequencies: Tensor,
    table: Tensor,
    rows: Tensor,
    nodes: Sequence[int],
    boxes: Sequence[float],
) -> Tensor:
    """Launch the kernel of the way forward; arguments and result as in `encode`."""
    given = _Points(points, frequencies, table, rows, nodes, boxes)
    out = points.new_empty(len(points), given.size)
    if len(points):
        given.struct.out = out.data_ptr()
        threads, items = launcher.threads(_THREADS), len(points) * (1 + len(frequencies) + given.levels)
        launcher.launch("encoding", "encode_points", (-(-items // threads), 1), threads, given.struct)
    return out


def run_encode_backward(
    launcher: KernelLauncher,
    gradient: Tensor,
    encoded: Tensor,
    points: Tensor,
    frequencies: Tensor,
    table: Tensor,
    rows: Tensor,
    nodes: Sequence[int],
    boxes: Sequence[float],
    wants_points: bool,
    wants_table: bool,
) -> tuple[Tensor, Tensor]:
    """Launch the kernel of the way back; arguments and results as in `encode_backward`."""
    given = _Points(points, frequencies, table, rows, nodes, boxes)
    gradient, encoded = gradient.contiguous(), encoded.contiguous()
    v_points = torch.empty_like(given.points) if wants_points else points.new_empty(0)
    v_table = torch.zeros_like(given.table) if wants_table else points.new_empty(0)
    given.struct.out, given.struct.v_out = encoded.data_ptr(), gradient.data_ptr()
    given.struct.v_points = v_points.data_ptr() if wants_points else None
    given.struct.v_table = v_table.data_ptr() if wants_table else None
    block_rows = int(wants_points) + (given.levels if wants_table else 0)
    if len(points) and block_rows:
        threads = launcher.threads(_THREADS)
        launcher.launch("encoding", "encode_backward", (-(-len(points) // threads), block_rows), threads, given.struct)
    return v_points, v_table
