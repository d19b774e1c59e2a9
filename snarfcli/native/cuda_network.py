"""The canonical occupancy network on a GPU: packing its weights and evaluating it, two kernels (csrc/cuda/network.cu)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from ctypes import Structure, c_float, c_int, c_longlong, c_void_p
from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.native import cuda_driver
from snarfcli.native.cuda_arrays import FeatureLevel, aligned, feature_levels
from snarfcli.native.cuda_driver import KernelLauncher

__all__ = ["NetworkArrays", "evaluate_network", "fits", "run_network"]

_MOST_LAYERS = 16  # kMostLayers, kMostLevels and kPackingThreads of csrc/cuda/network.cu
_MOST_LEVELS = 8
_PACKING_THREADS = 128
_COLUMNS = 32  # kColumns and kPadding of csrc/cuda/products.cuh
_PADDING = 16
_WIDEST = {128: 256, 64: 384}  # outputs of a layer by the number of points of a block: a warp for 32 of them
_NARROW = 128  # layers up to this width leave room for several smaller blocks on a multiprocessor
_KERNELS = {"highest": "float32", "high": "tf32", "medium": "tf32", "bfloat16": "bfloat16"}
_BYTES = {"float32": 4, "tf32": 4, "bfloat16": 2}


class _Packing(Structure):
    """`Packing` of csrc/cuda/network.cu."""

    _fields_ = [
        *((name, c_void_p * (_MOST_LAYERS + 1)) for name in ("weights", "lengths", "biases")),
        *((name, c_void_p) for name in ("packed", "packed_biases", "last")),
        *((name, c_int) for name in ("layers", "point_layers", "code_layer", "width", "encoded", "codes")),
        *((name, c_int) for name in ("hidden_count", "encoded_count", "code_count")),
    ]


class _Activation(Structure):
    """`Activation` of csrc/cuda/products.cuh."""

    _fields_ = [("kind", c_int), ("binary_decay", c_float), ("per_sharpness", c_float)]


class _Evaluation(Structure):
    """`Evaluation` of csrc/cuda/network.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("points", "pose", "seen", "part_codes", "code_bias", "frequencies", "table")),
        *((name, c_void_p) for name in ("segments", "weights", "biases", "last", "out")),
        ("count", c_longlong),
        ("levels", FeatureLevel * _MOST_LEVELS),
        ("activation", _Activation),
        ("radius", c_float),
        ("slope", c_float),
        *((name, c_int) for name in ("layers", "point_layers", "code_layer", "width", "encoded", "codes")),
        *((name, c_int) for name in ("code_count", "parts", "poses", "frequency_count", "level_count", "features")),
        ("segment_count", c_int),
    ]


@dataclass
class NetworkArrays:
    """A network and its arguments; see `networks.occupancy` for the fields."""

    points: Tensor
    pose: Tensor
    codes: Tensor
    code_bias: Tensor | None
    seen: Tensor | None
    weights: Sequence[Tensor]
    lengths: Sequence[Tensor]
    biases: Sequence[Tensor]
    frequencies: Tensor
    table: Tensor
    rows: Tensor
    segments: Tensor
    takes_point: Sequence[int]
    code_layer: int
    nodes: Sequence[int]
    boxes: Sequence[float]
    activation: int
    sharpness: float
    radius: float
    slope: float

    @property
    def layers(self) -> int:
        """Number of layers without the last."""
        return len(self.weights) - 1

    @property
    def levels(self) -> int:
        """Number of levels of the feature grids."""
        return len(self.nodes) // 3

    @property
    def encoded_count(self) -> int:
        """Number of values of an encoded point."""
        return 3 + 6 * len(self.frequencies) + self.levels * self.table.shape[1]

    @property
    def padded(self) -> dict[str, int]:
        """Numbers of values in shared memory, of each point."""
        return {
            "width": _round_up(len(self.biases[0]), _COLUMNS),
            "encoded": _round_up(self.encoded_count, _PADDING),
            "codes": _round_up(self.codes.shape[2], _PADDING) if self.code_layer >= 0 else 0,
        }


def evaluate_network(arrays: NetworkArrays, precision: str) -> Tensor | None:
    """Return the logits [N] on the GPU of the points, or None for a network that `fits` rejects; never waits for the GPU."""
    with torch.cuda.device(arrays.points.device):
        launcher = cuda_driver.gpu(arrays.points)
        return run_network(launcher, arrays, precision) if fits(launcher, arrays, precision) else None


def fits(launcher: KernelLauncher, arrays: NetworkArrays, precision: str) -> bool:
    """Return whether the kernels can evaluate a network.

    They take 1 to 16 equal hidden layers of at most 384 outputs, one of which takes the pose code, if there is one, and at most
    8 levels of feature grids, as far as the values of 64 points have room in the shared memory of a block.
    """
    width = len(arrays.biases[0])
    is_plain = len(arrays.biases[-1]) == 1 and all(len(bias) == width for bias in arrays.biases[:-1])
    has_place = arrays.code_layer < arrays.layers and (arrays.code_layer < 0 or arrays.codes.shape[2] > 0)
    is_small = 1 <= arrays.layers <= _MOST_LAYERS and arrays.levels <= _MOST_LEVELS
    return is_plain and has_place and is_small and _points_at_once(launcher, arrays, _kernels(launcher, precision)) is not None


def run_network(launcher: KernelLauncher, arrays: NetworkArrays, precision: str) -> Tensor:
    """Launch the kernels; see `evaluate_network`."""
    kernels = _kernels(launcher, precision)
    points = arrays.points.contiguous()
    out = points.new_empty(len(points))
    if not len(points):
        return out
    at_once = _points_at_once(launcher, arrays, kernels)
    assert at_once is not None  # see `fits`
    packed, biases, last = _pack(launcher, arrays, kernels)
    pose, codes, frequencies, segments, rows = (
        tensor.contiguous() for tensor in (arrays.pose, arrays.codes, arrays.frequencies, arrays.segments, arrays.rows)
    )
    table, seen, code_bias = aligned(arrays.table), _contiguous(arrays.seen), _contiguous(arrays.code_bias)
    call = _Evaluation(
        points.data_ptr(),
        pose.data_ptr(),
        _pointer(seen),
        codes.data_ptr(),
        _pointer(code_bias),
        frequencies.data_ptr(),
        table.data_ptr(),
        segments.data_ptr(),
        packed.data_ptr(),
        biases.data_ptr(),
        last.data_ptr(),
        out.data_ptr(),
        len(points),
        feature_levels(_MOST_LEVELS, table, rows, arrays.nodes, arrays.boxes),
        _Activation(arrays.activation, -arrays.sharpness / math.log(2), 1 / arrays.sharpness),
        arrays.radius,
        arrays.slope,
        **_sizes(arrays),
    )
    call.poses, call.parts, call.code_count = codes.shape
    call.frequency_count, call.segment_count = len(frequencies), len(segments)
    call.level_count, call.features = arrays.levels, table.shape[1]
    blocks, threads = -(-len(points) // at_once), call.width // _COLUMNS * 32
    shared_bytes = _shared_bytes(arrays, kernels, at_once)
    launcher.launch("network", f"evaluate_{kernels}_{at_once}", (blocks, 1), threads, call, shared_bytes)
    return out


def _pack(launcher: KernelLauncher, arrays: NetworkArrays, kernels: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return the packed weights, the biases of all layers but the last, and the last layer's weights and bias."""
    sizes = _sizes(arrays)
    given = [[tensor.contiguous() for tensor in group] for group in (arrays.weights, arrays.lengths, arrays.biases)]
    call = _Packing(**sizes)
    for array, tensors in zip((call.weights, call.lengths, call.biases), given, strict=True):
        array[: len(tensors)] = [tensor.data_ptr() for tensor in tensors]
    call.hidden_count, call.encoded_count, call.code_count = len(given[2][0]), arrays.encoded_count, arrays.codes.shape[2]
    width, layers = call.width, arrays.layers
    inputs = (layers - 1) * width + sum(arrays.takes_point[:-1]) * call.encoded + call.codes
    points = arrays.points
    packed = points.new_empty(width * inputs * _BYTES[kernels] // 4)  # only room: the kernel writes its own type
    biases, last = points.new_empty(layers * width), points.new_empty(width + call.encoded + 1)
    call.packed, call.packed_biases, call.last = packed.data_ptr(), biases.data_ptr(), last.data_ptr()
    launcher.launch("network", f"pack_{kernels}", (width, layers + 1), launcher.threads(_PACKING_THREADS), call)
    return packed, biases, last


def _sizes(arrays: NetworkArrays) -> dict[str, int]:
    """Return the fields that the two structures share."""
    point_layers = sum(1 << layer for layer, takes in enumerate(arrays.takes_point) if takes)
    return {"layers": arrays.layers, "point_layers": point_layers, "code_layer": arrays.code_layer, **arrays.padded}


def _kernels(launcher: KernelLauncher, precision: str) -> str:
    """Return which kernels evaluate a precision; before compute capability 8.0 there are those of float32 only."""
    return _KERNELS[precision] if launcher.capability >= (8, 0) else "float32"


def _points_at_once(launcher: KernelLauncher, arrays: NetworkArrays, kernels: str) -> int | None:
    """Return the number of points of a block, or None if the network is too large.

    More points share the weights that a block reads, but few points would leave multiprocessors without work.
    """
    width = len(arrays.biases[0])
    possible = [
        points
        for points, widest in _WIDEST.items()
        if width <= widest
        and (points == min(_WIDEST) or width > _NARROW)
        and _shared_bytes(arrays, kernels, points) <= launcher.most_shared_bytes
    ]

    def in_turn(points: int) -> int:
        """Return how many points the busiest multiprocessor evaluates, with one block at a time."""
        blocks = -(-len(arrays.points) // points)
        return -(-blocks // max(launcher.multiprocessors, 1)) * points

    return min(possible, key=in_turn, default=None)


def _shared_bytes(arrays: NetworkArrays, kernels: str, points: int) -> int:
    return points * (sum(arrays.padded.values()) * _BYTES[kernels] + 4)


def _round_up(count: int, step: int) -> int:
    return -(-count // step) * step


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def _pointer(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()
