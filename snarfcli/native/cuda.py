"""The correspondence searches and their gradient on a GPU, and whether they can run here.

All kernels run on PyTorch's current stream. With a `capacity` nothing waits for the device, so that a search can be part of a
CUDA graph (run it once before the capture, to load the kernels). Without one the host waits once, for the number of roots.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.devices import why_no_gpu
from snarfcli.native.backend import why_no_kernels
from snarfcli.native.cuda_driver import gpu
from snarfcli.native.cuda_launches import run_backward, run_broyden, run_complete
from snarfcli.native.kernel_cache import cache_folder
from snarfcli.native.nvrtc import nvrtc_version

__all__ = ["broyden_search", "complete_search", "cuda_status", "implicit_backward"]


def complete_search(
    points: Tensor,
    transforms: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    active_cells: Tensor | None,
    tolerance: float,
    max_steps: int,
    orientation_preserving: bool,
    capacity: int | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find the roots of T(x) [x; 1] = x' in every active cell; see `ops.complete_search` for arguments and results.

    The results do not depend on how the work was divided on the device: the same input gives the same bits. If there are more
    roots than `capacity`, it is not determined which of them are returned. The work is spread evenly over the device by lists
    whose length depends on the number of queries and on `capacity`; where folds fill them, as no body measured did, no root is
    lost, but the search takes longer and the last bits of roots may vary.

    Raises:
        ValueError: 2^31 queries or cells, or more.
        RuntimeError: the kernels cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(points.device):
        settings = (active_cells, tolerance, max_steps, orientation_preserving, capacity)
        return run_complete(gpu(points), points, transforms, lower, upper, shape, *settings)


def broyden_search(
    points: Tensor,
    transforms: Tensor,
    starts: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    tolerance: float,
    divergence: float,
    max_steps: int,
    exact_jacobian: bool,
    orientation_preserving: bool,
    capacity: int | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Run Broyden's method from every start; see `ops.broyden_search`. Determinism and errors as in `complete_search`."""
    with torch.cuda.device(points.device):
        settings = (tolerance, divergence, max_steps, exact_jacobian, orientation_preserving, capacity)
        return run_broyden(gpu(points), points, transforms, starts, lower, upper, shape, *settings)


def implicit_backward(
    gradient: Tensor,
    canonical: Tensor,
    query: Tensor,
    jacobian_inverse: Tensor,
    lower: Tensor,
    upper: Tensor,
    shape: Sequence[int],
    batch: int,
    count: int,
    wants_points: bool,
    wants_transforms: bool,
    into: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the gradients by the queries and by the transforms; see `implicit.implicit_backward`.

    The first is deterministic. The second is summed by atomics in an order that varies, and so do its last bits.
    """
    with torch.cuda.device(gradient.device):
        wants = (wants_points, wants_transforms)
        return run_backward(
            gpu(gradient), gradient, canonical, query, jacobian_inverse, lower, upper, shape, batch, count, *wants, into
        )


def cuda_status() -> str:
    """Return one line that states whether the CUDA kernels can run here, and on what, or why not. Never raises.

    The smallest kernel is compiled and loaded on every GPU to find out.
    """
    reason = why_no_gpu()
    if reason is not None:
        return f"not available: {reason}"
    usable: dict[str, None] = {}  # names, each once
    failed: dict[str, str] = {}
    for index in range(torch.cuda.device_count()):
        reason = why_no_kernels(torch.device("cuda", index))
        if reason is None:
            usable[torch.cuda.get_device_name(index)] = None
        else:
            failed[f"cuda:{index}"] = reason
    without = "".join(f"; on {name} the reference in PyTorch is used: {reason}" for name, reason in failed.items())
    if not usable:
        return f"not available{without}"
    kept = cache_folder() or "memory only, since there is no home folder"
    return f"available on {', '.join(usable)}; compiled on first use by NVRTC {nvrtc_version()}, kept in {kept}{without}"
