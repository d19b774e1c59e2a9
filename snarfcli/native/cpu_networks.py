"""The CPU library's functions for a training step on tensors: networks with gradients and the encoding of points."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import Structure, byref, c_float, c_int32, c_int64, c_void_p

import torch
from torch import Tensor

from snarfcli.native.library import native_library

__all__ = [
    "encode",
    "encode_backward",
    "feature_levels",
    "perceptron",
    "perceptron_backward",
    "pose_codes",
    "pose_codes_backward",
    "segment_distances",
]


class _Layer(Structure):
    _fields_ = [
        ("weights", c_void_p),
        ("bias", c_void_p),
        ("outputs", c_int32),
        ("takes_point", c_int32),
        ("takes_extras", c_int32),
        ("activation", c_int32),
    ]


class _Perceptron(Structure):
    _fields_ = [
        ("layers", c_void_p),
        ("layer_count", c_int32),
        ("first_count", c_int32),
        ("extra_count", c_int32),
        ("sharpness", c_float),
        ("threads", c_int32),
    ]


class _Level(Structure):
    _fields_ = [("lower", c_float * 3), ("size", c_float * 3), ("nodes", c_int32 * 3), ("rows", c_void_p)]


class _Encoding(Structure):
    _fields_ = [
        ("points", c_void_p),
        ("count", c_int64),
        ("frequencies", c_void_p),
        ("frequency_count", c_int32),
        ("levels", c_void_p),
        ("level_count", c_int32),
        ("features", c_int32),
        ("table", c_void_p),
        ("rows", c_int64),
        ("threads", c_int32),
    ]


class _Codes(Structure):
    _fields_ = [
        ("seen", c_void_p),
        ("pose", c_void_p),
        ("count", c_int64),
        ("poses", c_int64),
        ("parts", c_int32),
        ("size", c_int32),
        ("threads", c_int32),
    ]


def _pointer(tensor: Tensor | None) -> c_void_p:
    """Return the address of a tensor; null for none and for an empty one."""
    return c_void_p(None if tensor is None or not tensor.numel() else tensor.data_ptr())


def _check(code: int) -> None:
    if code == 2:
        raise MemoryError("a training step ran out of memory; give fewer points per step")
    if code:
        raise RuntimeError(f"the native library rejected its arguments (code {code})")


class _Network:
    """The C structures of a network, and the tensors that they point to, which must outlive a call."""

    def __init__(
        self,
        first: Tensor,
        extras: Tensor | None,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        takes_first: Sequence[int],
        takes_extras: Sequence[int],
        activation: int,
        sharpness: float,
    ) -> None:
        library = native_library()
        assert library is not None
        self.library = library
        library.snarf_saved_size.restype = c_int64
        self.first = first.contiguous()
        self.extras = None if extras is None else extras.contiguous()
        self.weights = [weight.contiguous() for weight in weights]
        self.biases = [bias.contiguous() for bias in biases]
        self.layers = (_Layer * len(weights))()
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            kind = activation if index + 1 < len(weights) else 0
            self.layers[index] = _Layer(
                weight.data_ptr(), bias.data_ptr(), len(bias), takes_first[index], takes_extras[index], kind
            )
        self.struct = _Perceptron(
            ctypes.cast(self.layers, c_void_p),
            len(weights),
            first.shape[1],
            0 if extras is None else extras.shape[1],
            sharpness,
            torch.get_num_threads(),
        )

    @property
    def inputs(self) -> tuple[c_void_p, c_void_p, c_int64]:
        return _pointer(self.first), _pointer(self.extras), c_int64(len(self.first))


def perceptron(
    first: Tensor,
    extras: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    takes_first: Sequence[int],
    takes_extras: Sequence[int],
    activation: int,
    sharpness: float,
) -> tuple[Tensor, Tensor]:
    """Evaluate a network; see `networks.perceptron` for arguments and results."""
    network = _Network(first, extras, weights, biases, takes_first, takes_extras, activation, sharpness)
    size = network.library.snarf_saved_size(byref(network.struct), c_int64(len(first)))
    saved, out = first.new_empty(max(size, 0)), first.new_empty(len(first), len(biases[-1]))
    _check(network.library.snarf_forward(byref(network.struct), *network.inputs, _pointer(saved), _pointer(out)))
    return out, saved


def perceptron_backward(
    gradient: Tensor,
    saved: Tensor,
    first: Tensor,
    extras: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    takes_first: Sequence[int],
    takes_extras: Sequence[int],
    activation: int,
    sharpness: float,
    wants_first: bool,
    wants_extras: bool,
) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor]]:
    """Return the gradients by the inputs, weights and biases; see `networks.perceptron_backward`."""
    network = _Network(first, extras, weights, biases, takes_first, takes_extras, activation, sharpness)
    gradient = gradient.contiguous()
    v_weights = [torch.empty_like(weight) for weight in network.weights]
    v_biases = [torch.empty_like(bias) for bias in network.biases]
    v_first = torch.empty_like(network.first) if wants_first else first.new_empty(0)
    v_extras = torch.empty_like(network.extras) if wants_extras and network.extras is not None else first.new_empty(0)
    pointers = [(c_void_p * len(weights))(*(v.data_ptr() for v in values)) for values in (v_weights, v_biases)]
    code = network.library.snarf_backward(
        byref(network.struct),
        *network.inputs,
        _pointer(saved),
        _pointer(gradient),
        *pointers,
        _pointer(v_first),
        _pointer(v_extras),
    )
    _check(code)
    return v_first, v_extras, v_weights, v_biases


def feature_levels(rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]) -> ctypes.Array[_Level]:
    """Return the C structures of feature grids, at least one; `rows` must outlive them. See `networks.encode`."""
    count = len(nodes) // 3
    levels = (_Level * max(count, 1))()
    start = 0
    for level in range(count):
        shape, box = nodes[3 * level : 3 * level + 3], boxes[6 * level : 6 * level + 6]
        lower, size = (c_float * 3)(*box[:3]), (c_float * 3)(*box[3:])
        levels[level] = _Level(lower, size, (c_int32 * 3)(*shape), rows.data_ptr() + 4 * start)
        start += shape[0] * shape[1] * shape[2]
    return levels


class _Points:
    """The C structures of an encoding, and the tensors that they point to."""

    def __init__(
        self, points: Tensor, frequencies: Tensor, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]
    ) -> None:
        library = native_library()
        assert library is not None
        self.library = library
        self.points, self.frequencies, self.table = points.contiguous(), frequencies.contiguous(), table.contiguous()
        self.rows = rows.contiguous()
        count = len(nodes) // 3
        self.levels = feature_levels(self.rows, nodes, boxes)
        self.size = 3 + 6 * len(frequencies) + count * table.shape[1]
        self.struct = _Encoding(
            self.points.data_ptr(),
            len(points),
            self.frequencies.data_ptr(),
            len(frequencies),
            ctypes.cast(self.levels, c_void_p),
            count,
            table.shape[1],
            self.table.data_ptr(),
            len(table),
            torch.get_num_threads(),
        )


def encode(
    points: Tensor, frequencies: Tensor, table: Tensor, rows: Tensor, nodes: Sequence[int], boxes: Sequence[float]
) -> Tensor:
    """Encode points; see `networks.encode` for arguments and results."""
    given = _Points(points, frequencies, table, rows, nodes, boxes)
    out = points.new_empty(len(points), given.size)
    _check(given.library.snarf_encode(byref(given.struct), _pointer(out)))
    return out


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
    """Return the gradients by the points and by the features; see `networks.encode_backward`."""
    given = _Points(points, frequencies, table, rows, nodes, boxes)
    gradient, encoded = gradient.contiguous(), encoded.contiguous()
    v_points = torch.empty_like(given.points) if wants_points else points.new_empty(0)
    v_table = torch.empty_like(given.table) if wants_table else points.new_empty(0)
    code = given.library.snarf_encode_backward(
        byref(given.struct), _pointer(encoded), _pointer(gradient), _pointer(v_points), _pointer(v_table)
    )
    _check(code)
    return v_points, v_table


def _codes(seen: Tensor, pose: Tensor, poses: int, size: int) -> _Codes:
    count, parts = seen.shape
    if tuple(pose.shape) != (count,) or pose.dtype != torch.int64:
        raise ValueError(f"pose: wanted int64 [{count}], got {pose.dtype} {list(pose.shape)}")
    return _Codes(seen.data_ptr(), pose.data_ptr(), count, poses, parts, size, torch.get_num_threads())


def pose_codes(seen: Tensor, codes: Tensor, pose: Tensor) -> Tensor:
    """Return the pose codes [N, K] of points; see `networks.pose_code` for arguments."""
    library = native_library()
    assert library is not None
    seen, codes, pose = seen.contiguous(), codes.contiguous(), pose.contiguous()
    if codes.ndim != 3 or codes.shape[1] != seen.shape[1]:
        raise ValueError(f"codes: wanted shape [B, {seen.shape[1]}, K], got {list(codes.shape)}")
    out = codes.new_empty(len(seen), codes.shape[2])
    _check(library.snarf_pose_codes(byref(_codes(seen, pose, len(codes), codes.shape[2])), _pointer(codes), _pointer(out)))
    return out


def pose_codes_backward(gradient: Tensor, seen: Tensor, pose: Tensor, poses: int) -> Tensor:
    """Return the gradient by the codes [B, P, K], from that by the points' codes [N, K]."""
    library = native_library()
    assert library is not None
    seen, gradient, pose = seen.contiguous(), gradient.contiguous(), pose.contiguous()
    if gradient.ndim != 2 or len(gradient) != len(seen):
        raise ValueError(f"gradient: wanted shape [{len(seen)}, K], got {list(gradient.shape)}")
    size = gradient.shape[1]
    v_codes = gradient.new_empty(poses, seen.shape[1], size)
    _check(library.snarf_pose_codes_backward(byref(_codes(seen, pose, poses, size)), _pointer(gradient), _pointer(v_codes)))
    return v_codes


def segment_distances(points: Tensor, segments: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances [N] to the nearest segment and their gradients [N, 3]; see `networks.capsules`."""
    library = native_library()
    assert library is not None
    points, segments = points.contiguous(), segments.contiguous()
    distance, direction = points.new_empty(len(points)), torch.empty_like(points)
    code = library.snarf_segment_distances(
        _pointer(points),
        c_int64(len(points)),
        _pointer(segments),
        c_int32(len(segments)),
        c_int32(torch.get_num_threads()),
        _pointer(distance),
        _pointer(direction),
    )
    _check(code)
    return distance, direction
