"""The occupancy network without gradients by native kernels, on a CPU or a GPU: several times as fast as layer by layer."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from ctypes import Structure, byref, c_float, c_int32, c_int64, c_void_p
from typing import Any

import torch
from torch import Tensor

from snarfcli.native.backend import choose_backend
from snarfcli.native.cpu_networks import feature_levels
from snarfcli.native.library import native_library
from snarfcli.networks import ACTIVATIONS, WeightNormLinear
from snarfcli.networks.occupancy import occupancy
from snarfcli.shape import OccupancyNetwork
from snarfcli.shape.network import LOGITS_PER_METRE, SOFTPLUS_SHARPNESS, part_codes

__all__ = ["can_evaluate", "evaluate", "occupancy_arguments"]


class _Layer(Structure):
    _fields_ = [
        ("weights", c_void_p),
        ("bias", c_void_p),
        ("outputs", c_int32),
        ("takes_point", c_int32),
        ("takes_extras", c_int32),
        ("activation", c_int32),
    ]


class _Network(Structure):
    _fields_ = [
        ("layers", c_void_p),
        ("layer_count", c_int32),
        ("frequencies", c_void_p),
        ("frequency_count", c_int32),
        ("levels", c_void_p),
        ("level_count", c_int32),
        ("features", c_int32),
        ("table", c_void_p),
        ("rows", c_int64),
        ("segments", c_void_p),
        ("segment_count", c_int32),
        ("radius", c_float),
        ("slope", c_float),
        ("sharpness", c_float),
        ("extra_count", c_int32),
    ]


def can_evaluate(network: torch.nn.Module, points: Tensor) -> bool:
    """Return whether `evaluate` can replace the forward pass.

    It can without gradients, in float32, with the native library on a CPU, or with CUDA kernels on a GPU.
    """
    return (
        isinstance(network, OccupancyNetwork)
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and points.dtype == network.linears[0].bias.dtype == torch.float32
        and _has_kernels(points.device)
    )


def _has_kernels(device: torch.device) -> bool:
    if device.type == "cpu":
        return native_library() is not None
    return device.type == "cuda" and choose_backend("auto", device) == "native"


def evaluate(
    network: OccupancyNetwork,
    canonical: Tensor,
    condition: Tensor,
    pose: Tensor,
    seen: Tensor | None = None,
    precision: str = "highest",
) -> Tensor:
    """Return `network(canonical, condition, pose, seen)` up to rounding: logits [M] at canonical points [M, 3].

    A point's logit does not depend on the other points. On a GPU nothing waits for the device.

    Args:
        network: in float32.
        canonical: [M, 3], float32, metres.
        condition: [B, C], pose condition of each pose.
        pose: [M], index of the pose of each point, 0 to B - 1.
        seen: [M, P], share of each part of the condition at each point; None for all of it.
        precision: of the products on a GPU, one of `PRECISIONS`; a CPU computes in float32.

    Raises:
        MemoryError: there is not enough memory.
    """
    if canonical.device.type == "cuda":
        return _evaluate_on_gpu(network, canonical, condition, pose, seen, precision)
    logits = canonical.new_empty(len(canonical))
    for index, one in enumerate(condition):
        if len(condition) == 1:
            logits[:] = _evaluate(network, canonical, one, seen)
        else:
            chosen = (pose == index).nonzero()[:, 0]
            logits[chosen] = _evaluate(network, canonical[chosen], one, None if seen is None else seen[chosen])
    return logits


# ---------------------------------------------------------------- GPU
def _evaluate_on_gpu(
    network: OccupancyNetwork, canonical: Tensor, condition: Tensor, pose: Tensor, seen: Tensor | None, precision: str
) -> Tensor:
    return occupancy(*occupancy_arguments(network, canonical, condition, pose, seen), precision)


def occupancy_arguments(
    network: OccupancyNetwork, canonical: Tensor, condition: Tensor, pose: Tensor, seen: Tensor | None = None
) -> tuple[Any, ...]:
    """Return the arguments of `networks.occupancy` but the precision; those of `evaluate` are given."""
    config, layers = network.config, network.linears
    code, bias = canonical.new_empty(1, 1, 0), None
    if network.pose_code is None:
        seen = None
    elif seen is None:
        code = network.pose_code(condition)[:, None]
    else:
        code, bias = part_codes(network.pose_code, condition, seen.shape[1]), network.pose_code.bias
    weights, lengths = [layer.weight for layer in layers if not isinstance(layer, WeightNormLinear)], []
    if not weights:  # all are normalised
        normalised = [layer for layer in layers if isinstance(layer, WeightNormLinear)]
        weights, lengths = [layer.direction for layer in normalised], [layer.length for layer in normalised]
    elif len(weights) < len(layers):
        weights = [layer.weight for layer in layers]
    grids = network.grids
    table, rows, nodes, boxes = grids.arrays if grids else (canonical.new_empty(0, 1), network.frequencies.new_empty(0), [], [])
    return (
        canonical,
        pose,
        code,
        bias,
        seen,
        weights,
        lengths,
        [layer.bias for layer in layers],
        network.frequencies,
        table,
        rows.int(),
        network.bones if config.prior_radius_m is not None else network.bones[:0],
        [int(index == 0 or index in config.skip_layers) for index in range(len(layers))],
        config.condition_layer if network.conditioned else -1,
        nodes,
        boxes,
        ACTIVATIONS[config.activation],
        SOFTPLUS_SHARPNESS,
        config.prior_radius_m or 0.0,
        LOGITS_PER_METRE,
    )


# ---------------------------------------------------------------- CPU
def _evaluate(network: OccupancyNetwork, canonical: Tensor, condition: Tensor, seen: Tensor | None) -> Tensor:
    """Return the logits [M] at points [M, 3] of one pose with condition [C]."""
    library, config = native_library(), network.config
    assert library is not None  # see can_evaluate
    extras = seen.float().contiguous() if network.conditioned and seen is not None else None
    count = 0 if extras is None else extras.shape[1]
    tensors = list(_layer_tensors(network, condition, count))  # must outlive the call, like all memory it points to
    layers = (_Layer * len(tensors))()
    for index, (weight, bias) in enumerate(tensors):
        layers[index] = _Layer(
            weight.data_ptr(),
            bias.data_ptr(),
            len(bias),
            index == 0 or index in config.skip_layers,
            count > 0 and index == config.condition_layer,
            ACTIVATIONS[config.activation] if index < config.depth else 0,
        )
    points, frequencies, bones = (values.float().contiguous() for values in (canonical, network.frequencies, network.bones))
    grids = network.grids
    table = (grids.table if grids else points.new_empty(0)).float().contiguous()
    levels = feature_levels(grids.rows, grids.nodes, grids.boxes) if grids else feature_levels(table, [], [])
    native = _Network(
        ctypes.cast(layers, c_void_p),
        len(layers),
        frequencies.data_ptr(),
        len(frequencies),
        ctypes.cast(levels, c_void_p),
        len(levels) if grids else 0,
        grids.features if grids else 0,
        table.data_ptr(),
        len(table),
        bones.data_ptr(),
        0 if config.prior_radius_m is None else len(bones),
        config.prior_radius_m or 0.0,
        LOGITS_PER_METRE,
        SOFTPLUS_SHARPNESS,
        count,
    )
    out = points.new_empty(len(points))
    code = library.snarf_evaluate(
        byref(native),
        c_void_p(points.data_ptr()),
        c_void_p(None if extras is None else extras.data_ptr()),
        c_int64(len(points)),
        c_int32(torch.get_num_threads()),
        c_void_p(out.data_ptr()),
    )
    if code == 2:
        raise MemoryError("evaluating the shape ran out of memory; evaluate fewer points at once")
    if code:
        raise RuntimeError(f"the native library rejected the network (code {code})")
    return out


def _layer_tensors(network: OccupancyNetwork, condition: Tensor, parts: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield weight and bias of each layer for one condition [C]; columns: previous layer, encoded point, parts seen.

    The pose code is added to the bias. If the points see `parts` of the condition, it becomes that number of columns instead,
    since it is linear in the shares seen.
    """
    config = network.config
    for index, layer in enumerate(network.linears):
        weight, bias = layer.weight, layer.bias
        columns = []
        if network.pose_code is not None and index == config.condition_layer:
            weight, code = weight.tensor_split((weight.shape[1] - config.condition_size,), dim=1)
            if parts:
                mapping = network.pose_code.weight.unflatten(1, (parts, -1))  # [K, P, C / P]
                columns = [code @ torch.einsum("pc,kpc->kp", condition.view(parts, -1), mapping)]
                bias = bias + code @ network.pose_code.bias
            else:
                bias = bias + code @ network.pose_code(condition)
        if index > 0 and index in config.skip_layers:
            weight = weight / math.sqrt(2)
        yield torch.cat([weight, *columns], 1).contiguous(), bias.contiguous()
