"""The distance to the nearest of some line segments, as a torch.library operator."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.native import cpu_networks, cuda_segments
from snarfcli.native.backend import choose_backend
from snarfcli.segments import distance_to_segments

__all__ = ["nearest_segment", "run_segment_distance"]

_KERNELS = {"cpu": cpu_networks.segment_distances, "cuda": cuda_segments.segment_distances}  # by the type of device


def run_segment_distance(points: Tensor, segments: Tensor) -> Tensor:
    """Return the distance of points [N, 3] to the nearest of the segments [S, 2, 3], [N], metres, with gradients by the points.

    By the native operator in float32 on a CPU or a GPU, else by PyTorch.
    """
    if not segments.requires_grad and _has_kernel(points, segments):
        return nearest_segment(points, segments)[0]
    return distance_to_segments(points, segments)


def _has_kernel(points: Tensor, segments: Tensor) -> bool:
    """Return whether native kernels take these arguments on this device."""
    takes = points.dtype == segments.dtype == torch.float32 and points.device.type in _KERNELS
    return takes and choose_backend("auto", points.device) == "native"


@torch.library.custom_op("snarf::nearest_segment", mutates_args=())
def nearest_segment(points: Tensor, segments: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances [N] of points [N, 3] to the nearest of the segments [S, 2, 3], and their gradients [N, 3]."""
    return _reference(points, segments)


def _reference(points: Tensor, segments: Tensor) -> tuple[Tensor, Tensor]:
    distance, back, *_ = torch.func.vjp(lambda given: distance_to_segments(given, segments), points)
    return distance, back(torch.ones_like(distance))[0]


@nearest_segment.register_kernel(["cpu", "cuda"])
def _(points, segments):
    run = _KERNELS[points.device.type] if _has_kernel(points, segments) else _reference
    return run(points, segments)


@nearest_segment.register_fake
def _(points, segments):
    return points.new_empty(len(points)), torch.empty_like(points)


def _remember(ctx, inputs, output):
    ctx.save_for_backward(output[1])
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)


def _gradient(ctx, gradient, _):
    return None if gradient is None else gradient[:, None] * ctx.saved_tensors[0], None


nearest_segment.register_autograd(_gradient, setup_context=_remember)
