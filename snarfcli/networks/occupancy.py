"""An occupancy network without gradients as one torch.library operator: what a GPU evaluates in one kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.native.cuda_network import NetworkArrays, evaluate_network
from snarfcli.networks.encoding import encode_reference
from snarfcli.networks.perceptron import perceptron_reference
from snarfcli.networks.pose_code import pose_code_reference
from snarfcli.precision import network_precision
from snarfcli.segments import distance_to_segments

__all__ = ["occupancy", "occupancy_reference"]


@torch.library.custom_op("snarf::occupancy", mutates_args=())
def occupancy(
    points: Tensor,
    pose: Tensor,
    codes: Tensor,
    code_bias: Tensor | None,
    seen: Tensor | None,
    weights: Sequence[Tensor],
    lengths: Sequence[Tensor],
    biases: Sequence[Tensor],
    frequencies: Tensor,
    table: Tensor,
    rows: Tensor,
    segments: Tensor,
    takes_point: Sequence[int],
    code_layer: int,
    nodes: Sequence[int],
    boxes: Sequence[float],
    activation: int,
    sharpness: float,
    radius: float,
    slope: float,
    precision: str,
) -> Tensor:
    """Evaluate an occupancy network; all numbers are float32.

    Args:
        points: [N, 3], metres.
        pose: [N], index of each point's pose, 0 to B - 1.
        codes: [B, P, K], code of each part of each pose.
        code_bias: [K], is added to a point's code; None for nothing.
        seen: [N, P], share of each part at each point; None if P is 1 and every point sees it.
        weights: [outputs, inputs] of each layer; columns for the layer before, then the encoded point, then the pose code.
        lengths: [outputs, 1] of each layer, lengths of the rows that the weights stand for; empty for those that they have.
        biases: [outputs] of each layer; the last has one output.
        frequencies, table, rows, nodes, boxes: encoding of the points, see `encode`.
        segments: [S, 2, 3], metres; S is 0 for no prior.
        takes_point: 1 for each layer that takes the encoded point, 0 for others. The first does; others then divide the layer
            before and the point by the square root of two.
        code_layer: layer that takes the pose code; -1 for none.
        activation: of all layers but the last, see `ACTIVATIONS`.
        sharpness: of the softplus.
        radius, slope: slope * (radius - distance to the nearest segment) is added, metres and per metre.
        precision: of the products, one of `PRECISIONS`: float32 ("highest"), TF32 ("high", "medium") or bfloat16 on a GPU with
            tensor cores. Sums, activations and the last layer are in float32.

    Returns:
        [N], logits.
    """
    arrays = NetworkArrays(
        points, pose, codes, code_bias, seen, weights, lengths, biases, frequencies, table, rows, segments,
        takes_point, code_layer, nodes, boxes, activation, sharpness, radius, slope,
    )  # fmt: skip
    return occupancy_reference(arrays, precision)


@occupancy.register_kernel("cuda")
def _(points, *rest):
    arrays, precision = NetworkArrays(points, *rest[:-1]), rest[-1]
    logits = evaluate_network(arrays, precision)
    return occupancy_reference(arrays, precision) if logits is None else logits


@occupancy.register_fake
def _(points, *rest):
    return points.new_empty(len(points))


def occupancy_reference(arrays: NetworkArrays, precision: str) -> Tensor:
    """The readable version of `occupancy`."""
    points, weights = arrays.points, list(arrays.weights)
    if arrays.lengths:
        pairs = zip(weights, arrays.lengths, strict=True)
        weights = [weight * (length / weight.norm(dim=1, keepdim=True)) for weight, length in pairs]
    coded, count = arrays.code_layer >= 0, arrays.codes.shape[2]
    for layer, weight in enumerate(weights):
        if layer and arrays.takes_point[layer]:
            kept = weight.shape[1] - (count if layer == arrays.code_layer else 0)
            weights[layer] = torch.cat([weight[:, :kept] / math.sqrt(2), weight[:, kept:]], 1)
    code = None
    if coded:
        given, codes = arrays.seen, arrays.codes
        code = codes[:, 0].index_select(0, arrays.pose) if given is None else pose_code_reference(given, codes, arrays.pose)
        code = code if arrays.code_bias is None else code + arrays.code_bias
    takes_code = [int(layer == arrays.code_layer) for layer in range(len(weights))]
    first = encode_reference(points, arrays.frequencies, arrays.table, arrays.rows, arrays.nodes, arrays.boxes)
    settings = (arrays.takes_point, takes_code, arrays.activation, arrays.sharpness)
    with network_precision(precision, points.device):
        logits = perceptron_reference(first, code, weights, arrays.biases, *settings)[:, 0].to(points.dtype)
    if len(arrays.segments):
        logits = logits + arrays.slope * (arrays.radius - distance_to_segments(points, arrays.segments))
    return logits.clone()
