"""The total variation of skinning weights on a GPU, by the kernels of csrc/cuda/variation.cu."""

from __future__ import annotations

from ctypes import Structure, c_int, c_void_p

import torch
from torch import Tensor

from snarfcli.native.cuda_driver import KernelLauncher, gpu

__all__ = ["run_total_variation", "total_variation"]

_THREADS = 256
_PAIR_BLOCKS = 64  # maximum; every block of the second kernel reads the counts of all of them
_CHANGE_BLOCKS = 1024  # maximum; the last kernel has one block
_MOST_NODES = 2**30


class _Variation(Structure):
    """`Variation` of csrc/cuda/variation.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("weights", "used", "size", "pairs", "shares", "total", "gradient")),
        ("nodes", c_int * 3),
        *((name, c_int) for name in ("count", "pair_blocks", "blocks")),
    ]


def total_variation(weights: Tensor, size: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the change of weights [D, H, W, J] from node to node, [], and its gradient; see `variation.total_variation`.

    Weights and `size` are float32, and on the same GPU as `used`. The same input gives the same bits. Runs on PyTorch's current
    stream, never waits for the device, and can be captured in a CUDA graph.

    Raises:
        ValueError: `used` is not bool [D, H, W], or there are more than 2^30 nodes.
        RuntimeError: the kernels cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(weights.device):
        return run_total_variation(gpu(weights), weights, size, used)


def run_total_variation(launcher: KernelLauncher, weights: Tensor, size: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
    """Launch the kernels; arguments and results as in `total_variation`."""
    shape, nodes = weights.shape[:3], weights.shape[:3].numel()
    if used is not None and (used.shape != shape or used.dtype != torch.bool):
        raise ValueError(f"used: wanted bool {list(shape)}, got {used.dtype} {list(used.shape)}")
    if nodes > _MOST_NODES:
        raise ValueError(f"weights: wanted at most 2^30 nodes on a GPU, got {nodes}")
    weights, size, used = weights.contiguous(), size.contiguous(), None if used is None else used.contiguous()
    if not weights.numel():
        return weights.new_zeros(()), torch.empty_like(weights)
    threads = launcher.threads(_THREADS)
    pair_blocks = min(-(-nodes // threads), _PAIR_BLOCKS)
    blocks = min(-(-weights.numel() // threads), _CHANGE_BLOCKS)
    total, gradient = weights.new_empty(()), torch.empty_like(weights)
    pairs = torch.empty(3 * pair_blocks, dtype=torch.int32, device=weights.device)
    shares = torch.empty(blocks, dtype=torch.float64, device=weights.device)
    arguments = _Variation(
        weights=weights.data_ptr(),
        used=None if used is None else used.data_ptr(),
        size=size.data_ptr(),
        pairs=pairs.data_ptr(),
        shares=shares.data_ptr(),
        total=total.data_ptr(),
        gradient=gradient.data_ptr(),
        nodes=(*shape[::-1],),
        count=weights.shape[3],
        pair_blocks=pair_blocks,
        blocks=blocks,
    )
    if used is not None:
        launcher.launch("variation", "count_pairs", (pair_blocks, 1), threads, arguments)
    launcher.launch("variation", "measure_changes", (blocks, 1), threads, arguments)
    launcher.launch("variation", "sum_changes", (1, 1), threads, arguments)
    return total, gradient
