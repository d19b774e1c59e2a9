"""The functions of the CPU library (csrc/include/snarf/api.h) on tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import Structure, byref, c_double, c_int32, c_int64, c_void_p
from typing import Any

import torch
from torch import Tensor

from snarfcli.native.capacity import fit_to_capacity
from snarfcli.native.library import native_library

__all__ = [
    "PreparedCells",
    "blend",
    "blend_backward",
    "broyden_search",
    "complete_search",
    "implicit_backward",
    "total_variation",
]


class _Field(Structure):
    _fields_ = [
        ("transforms", c_void_p),
        ("lower", c_double * 3),
        ("size", c_double * 3),
        ("nodes", c_int32 * 3),
        ("bytes_per_number", c_int32),
    ]


class _Queries(Structure):
    _fields_ = [("points", c_void_p), ("poses", c_int64), ("count", c_int64), ("threads", c_int32)]


class _Complete(Structure):
    _fields_ = [
        ("active", c_void_p),
        ("tolerance", c_double),
        ("max_steps", c_int32),
        ("orientation_preserving", c_int32),
    ]


class _Broyden(Structure):
    _fields_ = [
        ("starts", c_void_p),
        ("count", c_int64),
        ("tolerance", c_double),
        ("divergence", c_double),
        ("max_steps", c_int32),
        ("starts_are_points", c_int32),
        ("exact_jacobian", c_int32),
        ("orientation_preserving", c_int32),
    ]


class _Blending(Structure):
    _fields_ = [
        ("weights", c_void_p),
        ("bones", c_void_p),
        ("active", c_void_p),
        ("poses", c_int64),
        ("count", c_int64),
        ("nodes", c_int32 * 3),
        ("bytes_per_number", c_int32),
        ("threads", c_int32),
    ]


class _Variation(Structure):
    _fields_ = [
        ("weights", c_void_p),
        ("used", c_void_p),
        ("nodes", c_int32 * 3),
        ("count", c_int32),
        ("size", c_double * 3),
        ("threads", c_int32),
    ]


def blend(weights: Tensor, bones: Tensor, active: Tensor | None) -> Tensor:
    """Blend bone transforms [B, J, 12] with the weights [D, H, W, J] of the grid's nodes to [B, D * H * W, 12].

    With `active` [D-1, H-1, W-1] only corners of these cells are blended; other nodes get zeros.
    """
    weights, bones, active = _blending_inputs(weights, bones, active)
    out = weights.new_empty(len(bones), weights[..., 0].numel(), 12)
    if not out.numel():  # points that are blended as nodes are may be none
        return out
    blending = _blending(weights, bones, active)
    _raise_for(_library().snarf_blend(byref(blending), c_void_p(out.data_ptr())))
    return out


def blend_backward(
    gradient: Tensor, weights: Tensor, bones: Tensor, active: Tensor | None, wants: tuple[bool, bool]
) -> tuple[Tensor, Tensor]:
    """Return the gradients by the weights and by the bones, given that by `blend`'s result; empty if not wanted."""
    gradient = gradient.contiguous()
    weights, bones, active = _blending_inputs(weights, bones, active)
    v_weights = torch.empty_like(weights) if wants[0] else weights.new_empty(0)
    v_bones = torch.empty_like(bones) if wants[1] else bones.new_empty(0)
    if not gradient.numel():
        return v_weights.zero_(), v_bones.zero_()
    blending = _blending(weights, bones, active)
    results = [c_void_p(out.data_ptr() if wanted else None) for out, wanted in zip((v_weights, v_bones), wants, strict=True)]
    _raise_for(_library().snarf_blend_backward(byref(blending), c_void_p(gradient.data_ptr()), *results))
    return v_weights, v_bones


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

    Roots come in the order of their queries.

    Raises:
        MemoryError: there is not enough memory.
    """
    points, transforms = points.contiguous(), transforms.contiguous()
    active = None if active_cells is None else active_cells.contiguous()
    cells = None if active is None else active.data_ptr()
    settings = _Complete(cells, tolerance * _longest_side(lower, upper), max_steps, orientation_preserving)
    found = _search("snarf_complete_search", _field(transforms, lower, upper, shape), points, settings)
    return fit_to_capacity(*found, points, capacity)


_MANY = 2  # queries per cell: sorting these is faster than going through the sorted cells


class PreparedCells:
    """The cells of poses, sorted by their images once for many searches with few queries each.

    Args:
        transforms: [B, D * H * W, 12], blended transforms at the nodes.
        lower, upper, shape, active_cells, tolerance, max_steps, orientation_preserving: as for `complete_search`.

    Raises:
        MemoryError: there is not enough memory.
    """

    boxes: Tensor
    """[B, 2, 3], lower and upper corner of the box around the images of each pose, metres."""

    def __init__(
        self,
        transforms: Tensor,
        lower: Tensor,
        upper: Tensor,
        shape: Sequence[int],
        active_cells: Tensor | None,
        tolerance: float,
        max_steps: int,
        orientation_preserving: bool,
    ) -> None:
        library = _library()
        # kept alive: the structures have their addresses
        self._transforms = transforms.contiguous()
        every = torch.ones([n - 1 for n in shape], dtype=torch.bool)
        self._active = every if active_cells is None else active_cells.contiguous()
        self._count = int(self._active.sum())
        self._field = _field(self._transforms, lower, upper, shape)
        cells = c_void_p(self._active.data_ptr())
        self._settings = _Complete(cells, tolerance * _longest_side(lower, upper), max_steps, orientation_preserving)
        batch, threads = c_int64(len(transforms)), c_int32(torch.get_num_threads())
        handle, size = c_void_p(), c_int64()
        _raise_for(library.snarf_prepare(byref(self._field), batch, cells, threads, byref(handle), byref(size)))
        try:
            self._buffer, self.boxes = torch.empty(size.value, dtype=torch.uint8), transforms.new_empty(len(transforms), 2, 3)
        except BaseException:
            library.snarf_take_prepared(handle, None, None)
            raise
        results = (c_void_p(self._buffer.data_ptr()), c_void_p(self.boxes.data_ptr()))
        _raise_for(library.snarf_take_prepared(handle, *results))
        self._place = (c_void_p(self._buffer.data_ptr()), size)

    @property
    def bytes(self) -> int:
        """Memory of the sorted cells."""
        return len(self._buffer)

    def find(self, points: Tensor, capacity: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Find the same roots of points [B, N, 3] as `complete_search`; may be called by several threads at once."""
        points = points.contiguous()
        if points.shape[1] > _MANY * self._count:
            found = _search("snarf_complete_search", self._field, points, self._settings)
        else:
            found = _search("snarf_prepared_search", self._field, points, self._settings, self._place)
        return fit_to_capacity(*found, points, capacity)


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
    """Run Broyden's method from every start; see `ops.broyden_search` for arguments and results.

    Raises:
        MemoryError: there is not enough memory.
    """
    points, transforms, starts = points.contiguous(), transforms.contiguous(), starts.contiguous()
    length = _longest_side(lower, upper)
    limits = (tolerance * length, divergence * length, max_steps)
    flags = (starts.ndim == 4, exact_jacobian, orientation_preserving)
    settings = _Broyden(starts.data_ptr(), starts.shape[-2], *limits, *flags)
    found = _search("snarf_broyden_search", _field(transforms, lower, upper, shape), points, settings)
    return fit_to_capacity(*found, points, capacity)


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
    """Return the gradients by the queries and by the transforms; see `implicit.implicit_backward`."""
    gradient, canonical = gradient.contiguous(), canonical.contiguous()
    query, jacobian_inverse = query.contiguous(), jacobian_inverse.contiguous()
    v_points = gradient.new_zeros((batch, count, 3) if wants_points else 0)
    size = (batch, shape[0] * shape[1] * shape[2], 12) if wants_transforms else 0
    v_transforms = gradient.new_zeros(size) if into is None else into
    field = _field(gradient, lower, upper, shape)
    queries = _Queries(None, batch, count, torch.get_num_threads())
    code = _library().snarf_implicit_backward(
        byref(field),
        byref(queries),
        c_int64(len(query)),
        c_void_p(gradient.data_ptr()),
        c_void_p(canonical.data_ptr()),
        c_void_p(query.data_ptr()),
        c_void_p(jacobian_inverse.data_ptr()),
        c_void_p(v_points.data_ptr() if wants_points else None),
        c_void_p(v_transforms.data_ptr() if wants_transforms else None),
    )
    _raise_for(code)
    return v_points, v_transforms


def total_variation(weights: Tensor, size: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the change of weights [D, H, W, J] from node to node, [], and its gradient; see `variation.total_variation`."""
    weights, used = weights.contiguous(), None if used is None else used.contiguous()
    depth, height, width, count = weights.shape
    if used is not None and (used.shape != weights.shape[:3] or used.dtype != torch.bool):
        raise ValueError(f"used: wanted bool {list(weights.shape[:3])}, got {used.dtype} {list(used.shape)}")
    nodes = (c_int32 * 3)(width, height, depth)
    place = None if used is None else used.data_ptr()
    given = _Variation(weights.data_ptr(), place, nodes, count, (c_double * 3)(*size.tolist()), torch.get_num_threads())
    total, gradient = c_double(), torch.empty_like(weights)
    code = _library().snarf_total_variation(byref(given), byref(total), c_void_p(gradient.data_ptr()))
    _raise_for(code, "the loss on the skinning weights ran out of memory; give a smaller skinning.resolution")
    return weights.new_tensor(total.value), gradient


def _blending_inputs(weights: Tensor, bones: Tensor, active: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    return weights.contiguous(), bones.contiguous(), None if active is None else active.contiguous()


def _blending(weights: Tensor, bones: Tensor, active: Tensor | None) -> _Blending:
    """Describe contiguous inputs, which the caller keeps alive."""
    depth, height, width, count = weights.shape
    return _Blending(
        weights.data_ptr(),
        bones.data_ptr(),
        None if active is None else active.data_ptr(),
        len(bones),
        count,
        (c_int32 * 3)(width, height, depth),
        weights.element_size(),
        torch.get_num_threads(),
    )


def _library() -> ctypes.CDLL:
    library = native_library()
    if library is None:
        raise RuntimeError("the native library is not available")
    return library


def _longest_side(lower: Tensor, upper: Tensor) -> float:
    return float((upper - lower).max())


def _field(numbers: Tensor, lower: Tensor, upper: Tensor, shape: Sequence[int]) -> _Field:
    """Describe the grid; the contiguous `numbers`, which the caller keeps alive, give the address and the type."""
    nodes = (shape[2], shape[1], shape[0])
    size = (upper - lower) / torch.tensor([n - 1 for n in nodes]).to(lower)
    return _Field(
        numbers.data_ptr(),
        (c_double * 3)(*lower.tolist()),
        (c_double * 3)(*size.tolist()),
        (c_int32 * 3)(*nodes),
        numbers.element_size(),
    )


def _search(
    function: str, field: _Field, points: Tensor, settings: Structure, place: tuple[Any, ...] = ()
) -> tuple[Tensor, Tensor, Tensor]:
    library = _library()
    queries = _Queries(points.data_ptr(), points.shape[0], points.shape[1], torch.get_num_threads())
    handle, found = c_void_p(), c_int64()
    _raise_for(getattr(library, function)(*place, byref(field), byref(queries), byref(settings), byref(handle), byref(found)))
    try:
        canonical = points.new_empty(found.value, 3)
        inverse = points.new_empty(found.value, 3, 3)
        query = torch.empty(found.value, dtype=torch.long)
    except BaseException:
        library.snarf_take_roots(handle, None, None, None)
        raise
    results = (c_void_p(result.data_ptr()) for result in (canonical, query, inverse))
    _raise_for(library.snarf_take_roots(handle, *results))
    return canonical, query, inverse


_OUT_OF_MEMORY = "the correspondence search ran out of memory; give fewer points or poses at once"


def _raise_for(code: int, out_of_memory: str = _OUT_OF_MEMORY) -> None:
    if code == 2:
        raise MemoryError(out_of_memory)
    if code:
        raise RuntimeError(f"the native library rejected its arguments (code {code})")
