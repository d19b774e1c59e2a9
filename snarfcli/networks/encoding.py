"""Points as coordinates, waves and features of grids: a torch.library operator.

In float32, native kernels evaluate it, forward and backward, on a CPU (csrc/cpu/training.cpp) and on a GPU
(csrc/cuda/encoding.cu); everywhere else, and in other dtypes, the readable version does.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.constants import constant
from snarfcli.native import cpu_networks, cuda_encoding
from snarfcli.native.backend import choose_backend

__all__ = ["MAX_FEATURES", "encode", "encode_reference", "run_encoding"]

MAX_FEATURES = 64
"""Maximum number of features per node that the native operator takes (csrc/cpu/network_task.h)."""

_KERNELS = {"cpu": cpu_networks, "cuda": cuda_encoding}  # by the type of device


def encode_reference(
    points: Tensor, frequencies: Tensor, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]
) -> Tensor:
    """The readable version of `encode`."""
    angles = (points[:, None] * frequencies[:, None]).flatten(1)
    parts = [points, angles.sin(), angles.cos()]
    if nodes:
        parts.append(_features(points, table, rows, nodes, boxes).flatten(1))
    return torch.cat(parts, 1)


def _features(points: Tensor, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]) -> Tensor:
    """Return the features [N, levels, F] of the grids at points [N, 3], all levels and corners at once."""
    box = constant(boxes, points.device, points.dtype).view(-1, 2, 3)
    last = constant([count - 1 for count in nodes], points.device).view(-1, 3)
    place = (points[:, None] - box[:, 0]) / box[:, 1]
    is_inside = ((place >= 0) & (place <= last)).all(2)
    cell = torch.minimum(place.detach().nan_to_num().clamp_min(0).long(), last - 1)
    local = place - cell
    x, y, z = (torch.stack([1 - along, along], 2) for along in local.unbind(2))
    shares = (z[..., :, None, None] * y[..., None, :, None] * x[..., None, None, :]).flatten(2)
    strides, offsets, starts = _node_numbers(nodes)
    first = (cell * constant(strides, points.device).view(-1, 3)).sum(2) + constant(starts, points.device)
    at = first[..., None] + constant(offsets, points.device).view(-1, 8)
    padded = torch.cat([table, table.new_zeros(1, table.shape[1])])  # row -1: zeros
    row = rows.index_select(0, at.flatten()).long() % len(padded)
    values = padded.index_select(0, row).view(*at.shape, table.shape[1])  # whose gradient is faster than that of an index
    return torch.where(is_inside[..., None], (shares[..., None] * values).sum(2), 0)


def _node_numbers(nodes: Sequence[int]) -> tuple[list[int], list[int], list[int]]:
    """Return by how much the number of a node rises along x, y, z, and to a cell's corners; and the first of each level."""
    strides, offsets, starts, start = [], [], [], 0
    for level in range(len(nodes) // 3):
        width, height, depth = nodes[3 * level : 3 * level + 3]
        along = [1, width, width * height]
        strides += along
        offsets += [sum(step for axis, step in enumerate(along) if corner >> axis & 1) for corner in range(8)]
        starts.append(start)
        start += width * height * depth
    return strides, offsets, starts


def run_encoding(
    points: Tensor,
    frequencies: Tensor,
    table: Tensor | None = None,
    rows: Tensor | None = None,
    nodes: Sequence[int] = (),
    boxes: Sequence[float] = (),
) -> Tensor:
    """Encode points with gradients: by the native operator in float32 on a CPU or a GPU, else by PyTorch.

    Arguments and result: as those of `encode`; without a table there are no grids.
    """
    table = points.new_empty(0, 1) if table is None else table
    rows = torch.empty(0, dtype=torch.int32, device=points.device) if rows is None else rows
    run = encode if _has_kernel(points, table, nodes) else encode_reference
    return run(points, frequencies, table, rows, list(nodes), list(boxes))


def _has_kernel(points: Tensor, table: Tensor, nodes: Sequence[int]) -> bool:
    """Return whether native kernels take these arguments on this device."""
    kind = points.device.type
    takes = points.dtype == table.dtype == torch.float32 and kind in _KERNELS and table.shape[1] <= MAX_FEATURES
    takes &= kind != "cuda" or len(nodes) <= 3 * cuda_encoding.MAX_LEVELS
    return takes and choose_backend("auto", points.device) == "native"


@torch.library.custom_op("snarf::encode", mutates_args=())
def encode(
    points: Tensor, frequencies: Tensor, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]
) -> Tensor:
    """Encode points as coordinates, waves, and features interpolated in grids of several resolutions.

    Args:
        points: [N, 3], metres.
        frequencies: [K], radians per metre.
        table: [R, F], features.
        rows: row of each node's features, int32, the [D, H, W] nodes of all levels one after the other; -1 for zeros.
        nodes: W, H, D of each level.
        boxes: position of the first node and sides of a cell of each level, six numbers in metres.

    Returns:
        [N, 3 + 6 K + levels F]: x, sin(k x) for each k, cos(k x) for each k, features; outside of a level's box zeros.

    Source: features after Mueller et al., Instant Neural Graphics Primitives, SIGGRAPH 2022, Sec. 3, on dense grids.
    """
    return encode_reference(points, frequencies, table, rows, nodes, boxes)


@encode.register_kernel(["cpu", "cuda"])
def _(points, frequencies, table, rows, nodes, boxes):
    run = _KERNELS[points.device.type].encode if _has_kernel(points, table, nodes) else encode_reference
    return run(points, frequencies, table, rows, nodes, boxes)


@encode.register_fake
def _(points, frequencies, table, rows, nodes, boxes):
    return points.new_empty(len(points), 3 + 6 * len(frequencies) + len(nodes) // 3 * table.shape[1])


def _encode_backward_reference(gradient, points, frequencies, table, rows, nodes, boxes, wants):
    back = torch.func.vjp(lambda p, t: encode_reference(p, frequencies, t, rows, nodes, boxes), points, table)[1]
    v_points, v_table = back(gradient)
    return v_points if wants[0] else points.new_empty(0), v_table if wants[1] else points.new_empty(0)


@torch.library.custom_op("snarf::encode_backward", mutates_args=())
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
    """Return the gradients of a loss by the points and by the features (empty where not wanted), from that by the encoding.

    The first is deterministic. On a GPU the second is summed by float atomics in an order that varies, and so do its last bits.
    """
    return _encode_backward_reference(gradient, points, frequencies, table, rows, nodes, boxes, (wants_points, wants_table))


@encode_backward.register_kernel(["cpu", "cuda"])
def _(gradient, encoded, points, frequencies, table, rows, nodes, boxes, wants_points, wants_table):
    given, wants = (points, frequencies, table, rows, nodes, boxes), (wants_points, wants_table)
    if _has_kernel(points, table, nodes):
        return _KERNELS[points.device.type].encode_backward(gradient, encoded, *given, *wants)
    return _encode_backward_reference(gradient, *given, wants)


@encode_backward.register_fake
def _(gradient, encoded, points, frequencies, table, rows, nodes, boxes, wants_points, wants_table):
    v_points = torch.empty_like(points) if wants_points else points.new_empty(0)
    return v_points, torch.empty_like(table) if wants_table else points.new_empty(0)


def _encode_context(ctx, inputs, output):
    points, frequencies, table, rows, ctx.nodes, ctx.boxes = inputs
    ctx.save_for_backward(output, points, frequencies, table, rows)


def _encode_gradient(ctx, gradient):
    wants = ctx.needs_input_grad[0], ctx.needs_input_grad[2]
    v_points, v_table = encode_backward(gradient, *ctx.saved_tensors, ctx.nodes, ctx.boxes, *wants)
    return v_points if wants[0] else None, None, v_table if wants[1] else None, None, None, None


encode.register_autograd(_encode_gradient, setup_context=_encode_context)
