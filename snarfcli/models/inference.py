"""The canonical occupancy network without gradients on a CPU, by the native library: several times faster than layer by layer."""

from __future__ import annotations

import ctypes
import math
from ctypes import Structure, byref, c_float, c_int32, c_int64, c_void_p

import torch
from torch import Tensor

from snarfcli.deformer.library import native_library
from snarfcli.shape import OccupancyNetwork
from snarfcli.shape.network import LOGITS_PER_METRE, SOFTPLUS_SHARPNESS

__all__ = ["can_evaluate", "evaluate"]

_ACTIVATIONS = {"relu": 1, "softplus": 2}


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
        ("segments", c_void_p),
        ("segment_count", c_int32),
        ("radius", c_float),
        ("slope", c_float),
        ("sharpness", c_float),
        ("extra_count", c_int32),
    ]


def can_evaluate(network: torch.nn.Module, points: Tensor) -> bool:
    """Return whether `evaluate` can stand in for the network's own forward pass: no gradient, float32, CPU, and a library."""
    return (
        isinstance(network, OccupancyNetwork)
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and points.device.type == "cpu"
        and points.dtype == network.layers[0].bias.dtype == torch.float32
        and native_library() is not None
    )


def evaluate(
    network: OccupancyNetwork, canonical: Tensor, condition: Tensor, pose: Tensor, seen: Tensor | None = None
) -> Tensor:
    """Return what `network(canonical, condition, pose, seen)` returns, to rounding: logits [M] at canonical points [M, 3].

    Args:
        network: in full precision on the CPU.
        canonical: [M, 3] float32, metres.
        condition: pose condition of each pose, [B, C].
        pose: index of each point's pose, [M], 0 to B - 1.
        seen: how much each point sees of each part of the condition, [M, P]; all of it if None.

    Raises:
        MemoryError: there is not enough memory.
    """
    logits = canonical.new_empty(len(canonical))
    for number, one in enumerate(condition):
        if len(condition) == 1:
            logits[:] = _evaluate(network, canonical, one, seen)
        else:
            own = (pose == number).nonzero()[:, 0]
            logits[own] = _evaluate(network, canonical[own], one, None if seen is None else seen[own])
    return logits


def _evaluate(network: OccupancyNetwork, canonical: Tensor, condition: Tensor, seen: Tensor | None) -> Tensor:
    """Evaluate points of one pose; `condition` [C]."""
    config = network.config
    local = network.conditioned and seen is not None
    kept = [canonical.contiguous(), network.frequencies.float().contiguous(), network.bones.float().contiguous()]
    extras = seen.float().contiguous() if local else None
    layers = (_Layer * len(network.layers))()
    hidden = 0
    for index, layer in enumerate(network.layers):
        takes_point = index == 0 or index in config.skip_layers
        weight, bias = layer.weight, layer.bias
        joined = network.conditioned and index == config.condition_layer
        if joined:
            points = weight.shape[1] - config.condition_size
            code = weight[:, points:]
            weight = weight[:, :points]
            if local:
                parts = extras.shape[1]
                # The code is linear in what a point sees: one row of weights for each part of the condition.
                codes = torch.einsum("pc,kpc->kp", condition.view(parts, -1), network.pose_code.weight.unflatten(1, (parts, -1)))
                bias = bias + code @ network.pose_code.bias
                extra_weight = code @ codes
            else:
                bias = bias + code @ network.pose_code(condition)
        if index > 0 and index in config.skip_layers:
            weight = weight / math.sqrt(2)
        if joined and local:
            weight = torch.cat([weight, extra_weight], 1)
        weight, bias = weight.contiguous(), bias.contiguous()
        kept += [weight, bias]
        last = index == config.depth
        layers[index] = _Layer(
            weight.data_ptr(),
            bias.data_ptr(),
            len(bias),
            takes_point,
            joined and local,
            0 if last else _ACTIVATIONS[config.activation],
        )
    has_prior = config.prior_radius_m is not None
    native = _Network(
        ctypes.cast(layers, c_void_p),
        len(layers),
        kept[1].data_ptr(),
        len(kept[1]),
        kept[2].data_ptr(),
        len(kept[2]) if has_prior else 0,
        config.prior_radius_m or 0.0,
        LOGITS_PER_METRE,
        SOFTPLUS_SHARPNESS,
        extras.shape[1] if local else 0,
    )
    out = canonical.new_empty(len(canonical))
    code = native_library().snarf_evaluate(
        byref(native),
        c_void_p(kept[0].data_ptr()),
        c_void_p(extras.data_ptr() if local else None),
        c_int64(len(canonical)),
        c_int32(torch.get_num_threads()),
        c_void_p(out.data_ptr()),
    )
    if code == 2:
        raise MemoryError("evaluating the shape ran out of memory; give fewer points at once")
    if code:
        raise RuntimeError(f"the native library refused the network (code {code})")
    return out
