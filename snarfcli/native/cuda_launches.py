"""The kernels of csrc/cuda in the order of a search or a gradient, and their memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import Structure, c_double, c_int, c_longlong, c_void_p
from itertools import accumulate
from math import prod

import torch
from torch import Tensor

from snarfcli.native.cuda_arrays import aligned
from snarfcli.native.cuda_driver import KernelLauncher

__all__ = ["run_backward", "run_broyden", "run_complete"]

_BOUNDS_NUMBERS, _POLYNOMIAL_NUMBERS = 20, 60  # of one cell (csrc/cuda/parts.cuh)
_UNIT_INTEGERS = _ENTRY_INTEGERS = 4
_RECORD_NUMBERS = _BOUNDS_NUMBERS + _POLYNOMIAL_NUMBERS
_GROUP_BYTES = 1 << 28  # maximum memory for the records of cells that are searched together
_MOST_POSES = 65_535  # of a group: blocks of a grid along y
_MOST_BINS = 1 << 20  # of a pose; a bin costs about as much as a query
_FEWEST_BINS = 64
_THREADS = 128
_CELL_THREADS = 32  # per block of search_cells
_QUERY_BLOCKS = 256  # blocks that measure the queries; more would only queue for the same few atomics
_WARPS = 4224  # that keep a large GPU busy: 32 on each of 132 multiprocessors
_LEVELS = 4  # kLevels of csrc/include/snarf/search.h
_SAME_ROOT = 5e-3  # kSameRoot and kSameBroydenRoot of csrc/include/snarf/search.h
_SAME_BROYDEN_ROOT = 5e-2
_LIMIT = 2**31


class _Search(Structure):
    """`Search` of csrc/cuda/search.cuh."""

    _fields_ = [
        *((name, c_void_p) for name in ("points", "transforms", "lower", "upper", "active", "starts")),
        *((name, c_void_p) for name in ("bounds", "polynomials", "units", "listed", "region")),
        *((name, c_void_p) for name in ("entries", "entered", "stopped")),
        *((name, c_void_p) for name in ("bin_count", "bin_end", "sorted", "sorted_query")),
        *((name, c_void_p) for name in ("root", "root_order", "root_next", "staged", "head", "kept", "end")),
        *((name, c_void_p) for name in ("canonical", "query", "jacobian_inverse", "found")),
        *((name, c_longlong) for name in ("count", "queries")),
        ("list_begin", c_longlong * (_LEVELS + 2)),
        *((name, c_double) for name in ("tolerance", "divergence", "same_root")),
        ("nodes", c_int * 3),
        *((name, c_int) for name in ("first_pose", "first_cell", "cells", "bins", "cuts", "level")),
        *((name, c_int) for name in ("slots", "capacity", "start_count")),
        *((name, c_int) for name in ("starts_are_points", "max_steps", "exact_jacobian", "orientation_preserving")),
    ]


class _Backward(Structure):
    """`Backward` of csrc/cuda/implicit.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("gradient", "canonical", "query", "jacobian_inverse", "lower", "upper")),
        *((name, c_void_p) for name in ("v_points", "v_transforms")),
        *((name, c_longlong) for name in ("roots", "count", "queries")),
        ("nodes", c_int * 3),
    ]


def run_complete(
    launcher: KernelLauncher,
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
    """Launch the kernels of a complete search; arguments and results as in `cuda.complete_search`."""
    points, transforms = points.contiguous(), aligned(transforms)
    lower, upper = lower.to(points).contiguous(), upper.to(points).contiguous()
    active = None if active_cells is None else active_cells.contiguous()
    batch, count = points.shape[:2]
    cells = prod(n - 1 for n in shape)
    _check_limits(batch * count, cells)
    if batch * count == 0 or cells == 0:
        return _nothing(points, capacity)
    arguments = _arguments(points, transforms, lower, upper, shape)
    arguments.tolerance, arguments.max_steps = tolerance, max_steps
    arguments.orientation_preserving, arguments.same_root = orientation_preserving, _SAME_ROOT
    arguments.active = None if active is None else active.data_ptr()
    arguments.bins = min(max(count, _FEWEST_BINS), _MOST_BINS)
    record_bytes = _RECORD_NUMBERS * points.element_size()
    cells_at_once = min(cells, max(_GROUP_BYTES // record_bytes, 1))
    poses_at_once = max(min(batch, _GROUP_BYTES // (record_bytes * cells_at_once), _MOST_POSES), 1)

    def find() -> None:
        for first_cell in range(0, cells, cells_at_once):
            for first_pose in range(0, batch, poses_at_once):
                arguments.first_cell, arguments.first_pose = first_cell, first_pose
                arguments.cells = min(cells_at_once, cells - first_cell)
                _search_group(launcher, points, arguments, min(poses_at_once, batch - first_pose))

    return _gather(launcher, points, arguments, capacity, find)


def _search_group(launcher: KernelLauncher, points: Tensor, arguments: _Search, poses: int) -> None:
    """Find the roots of `poses` poses in the cells named by the arguments."""
    count, cells, bins, cuts = points.shape[1], arguments.cells, arguments.bins, _most_cuts(points.shape[1])
    whole = {"dtype": torch.int32, "device": points.device}
    # All that starts at zero is one buffer, filled by one kernel.
    zeros = torch.zeros(poses * (15 + bins) + _LEVELS + 1, **whole)
    region, listed, bin_count, entered = zeros.split([12 * poses, 3 * poses, poses * bins, _LEVELS + 1])
    bin_end, units = torch.empty_like(bin_count), torch.empty(poses * (cells + cuts), _UNIT_INTEGERS, **whole)
    bounds = points.new_empty(poses * cells, _BOUNDS_NUMBERS)
    polynomials = points.new_empty(poses * cells, _POLYNOMIAL_NUMBERS)
    in_bins, in_bins_query = points.new_empty(poses * count, 3), torch.empty(poses * count, **whole)
    list_begin = list(accumulate(_rooms(poses * count, arguments.slots), initial=0))
    entries = torch.empty(list_begin[-1], _ENTRY_INTEGERS, **whole)
    cell_warps = _blocks(_WARPS, poses)
    stopped = torch.empty(poses * cell_warps, **whole)
    arguments.region, arguments.listed, arguments.bin_count = region.data_ptr(), listed.data_ptr(), bin_count.data_ptr()
    arguments.bounds, arguments.polynomials, arguments.units = bounds.data_ptr(), polynomials.data_ptr(), units.data_ptr()
    arguments.bin_end, arguments.sorted, arguments.sorted_query = (
        bin_end.data_ptr(),
        in_bins.data_ptr(),
        in_bins_query.data_ptr(),
    )
    arguments.entries, arguments.entered, arguments.stopped = entries.data_ptr(), entered.data_ptr(), stopped.data_ptr()
    arguments.cuts, arguments.list_begin[:] = cuts, list_begin
    threads, cell_threads = launcher.threads(_THREADS), launcher.threads(_CELL_THREADS)

    def launch(source: str, kernel: str, blocks: tuple[int, int], block_threads: int = threads) -> None:
        launcher.launch(source, kernel, blocks, block_threads, arguments)

    cell_blocks, query_blocks = _blocks(cells, threads), _blocks(count, threads)
    launch("complete", "survey", (cell_blocks + min(query_blocks, _QUERY_BLOCKS), poses))
    launch("complete", "count_queries", (query_blocks, poses))
    torch.cumsum(bin_count, 0, dtype=torch.int32, out=bin_end)
    launch("complete", "place_queries", (cell_blocks + query_blocks, poses))
    launch("candidates", "search_cells", (cell_warps, poses), cell_threads)
    launch("candidates", "search_rest", (cell_warps, poses), cell_threads)
    full = _blocks(_WARPS * _CELL_THREADS, threads)
    for level in range(1, _LEVELS):
        arguments.level, room = level, list_begin[level + 1] - list_begin[level]
        launch("parts", "halve_parts", (min(_blocks(8 * room, threads), full), 1))
    launch("parts", "solve_parts", (min(_blocks(list_begin[1], threads), full), 1))


def _most_cuts(count: int) -> int:
    """Return how many cuts of crowded cells there is room for, given the queries of a pose; without room a cell stays whole."""
    return count // 8 + 1024


def _rooms(queries: int, slots: int) -> list[int]:
    """Return the lengths of the lists of entries: to be solved, of each level to be halved, and of the last level.

    Measured on bodies in extreme poses (benchmarks/bm_balance.py): at most 1.1 entries to be solved for each root reported, and
    0.16, 0.03, 0.007 and 0.004 of the other lists for each query. Entries without room are searched all the same, slowly.
    """
    to_halve = [queries >> level for level in range(1, _LEVELS)]
    return [room + 4096 for room in (max(queries, slots) + queries // 4, *to_halve, to_halve[-1])]


def run_broyden(
    launcher: KernelLauncher,
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
    """Launch the kernels of Broyden's search; arguments and results as in `cuda.broyden_search`."""
    points, transforms, starts = points.contiguous(), aligned(transforms), starts.contiguous()
    lower, upper = lower.to(points).contiguous(), upper.to(points).contiguous()
    batch, count = points.shape[:2]
    _check_limits(batch * count, 0)
    start_count = starts.shape[-2]
    if batch * count == 0 or start_count == 0:
        return _nothing(points, capacity)
    arguments = _arguments(points, transforms, lower, upper, shape)
    arguments.starts, arguments.start_count, arguments.starts_are_points = starts.data_ptr(), start_count, starts.ndim == 4
    arguments.tolerance, arguments.divergence, arguments.max_steps = tolerance, divergence, max_steps
    arguments.exact_jacobian, arguments.orientation_preserving = exact_jacobian, orientation_preserving
    arguments.same_root = _SAME_BROYDEN_ROOT
    threads = launcher.threads(_THREADS)

    def find() -> None:
        for first_pose in range(0, batch, _MOST_POSES):
            arguments.first_pose = first_pose
            blocks = (_blocks(count, threads), min(_MOST_POSES, batch - first_pose))
            launcher.launch("broyden", "search_from_starts", blocks, threads, arguments)

    return _gather(launcher, points, arguments, capacity, find)


def _gather(
    launcher: KernelLauncher, points: Tensor, arguments: _Search, capacity: int | None, find: Callable[[], None]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Call `find`, which reports roots, and return them ordered by query."""
    queries = points.shape[0] * points.shape[1]
    threads = launcher.threads(_THREADS)
    whole = {"dtype": torch.int32, "device": points.device}
    blocks = (_blocks(queries, threads), 1)
    slots = _first_guess(queries) if capacity is None else _slots_for(capacity)
    while True:
        slots = min(slots, _LIMIT - 1)
        state = torch.zeros(2 * queries + 1, **whole)
        head, end, staged = state.split([queries, queries, 1])
        root, kept = points.new_empty(slots, 12), torch.empty(queries, **whole)
        root_order, root_next = torch.empty(2, slots, **whole)
        arguments.root, arguments.root_order, arguments.root_next = root.data_ptr(), root_order.data_ptr(), root_next.data_ptr()
        arguments.head, arguments.end, arguments.staged = head.data_ptr(), end.data_ptr(), staged.data_ptr()
        arguments.kept, arguments.slots = kept.data_ptr(), slots
        find()
        launcher.launch("gather", "collect_roots", blocks, threads, arguments)
        torch.cumsum(kept, 0, dtype=torch.int32, out=end)
        if capacity is not None:
            break
        total, reported = state[-2:].tolist()  # the only synchronisation: the size of the results
        if reported <= slots:
            break
        slots = reported
    out = _padding(points, capacity) if capacity is not None else _unfilled(points, total)
    for name, tensor in zip(("canonical", "query", "jacobian_inverse", "found"), out, strict=True):
        setattr(arguments, name, tensor.data_ptr())
    arguments.capacity = len(out[0])
    launcher.launch("gather", "write_roots", blocks, threads, arguments)
    return out


def _first_guess(queries: int) -> int:
    """Return a guess of the number of roots; if there are more, the search is repeated."""
    return queries + min(queries, 1 << 20) + 1024


def _slots_for(capacity: int) -> int:
    """Return the number of slots for `capacity` roots, some of which neighbouring cells report twice."""
    return capacity + capacity // 4 + 1024


def run_backward(
    launcher: KernelLauncher,
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
    """Launch the backward kernel; arguments and results as in `cuda.implicit_backward`."""
    given = {
        "gradient": gradient.contiguous(),
        "canonical": canonical.contiguous(),
        "query": query.contiguous(),
        "jacobian_inverse": jacobian_inverse.contiguous(),
        "lower": lower.to(gradient).contiguous(),
        "upper": upper.to(gradient).contiguous(),
    }
    v_points = gradient.new_zeros((batch, count, 3) if wants_points else 0)
    v_transforms = gradient.new_zeros((batch, prod(shape), 12) if wants_transforms else 0) if into is None else into
    arguments = _Backward(**{name: tensor.data_ptr() for name, tensor in given.items()})
    arguments.v_points = v_points.data_ptr() if wants_points else None
    arguments.v_transforms = v_transforms.data_ptr() if wants_transforms else None
    arguments.roots, arguments.count, arguments.queries = len(query), count, batch * count
    arguments.nodes[:] = tuple(shape)[::-1]
    threads = launcher.threads(_THREADS)
    if len(query):
        launcher.launch("implicit", "implicit_backward", (_blocks(len(query), threads), 1), threads, arguments)
    return v_points, v_transforms


def _arguments(points: Tensor, transforms: Tensor, lower: Tensor, upper: Tensor, shape: Sequence[int]) -> _Search:
    arguments = _Search(points.data_ptr(), transforms.data_ptr(), lower.data_ptr(), upper.data_ptr())
    arguments.count, arguments.queries = points.shape[1], points.shape[0] * points.shape[1]
    arguments.nodes[:] = tuple(shape)[::-1]
    return arguments


def _blocks(items: int, threads: int) -> int:
    return -(-items // threads)


def _unfilled(points: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return uninitialised results: canonical, query, jacobian_inverse, and the number of roots."""
    long = {"dtype": torch.long, "device": points.device}
    return points.new_empty(rows, 3), torch.empty(rows, **long), points.new_empty(rows, 3, 3), torch.empty(1, **long)


def _padding(points: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return results without a root: query B * N, all else zero."""
    canonical, query, jacobian_inverse, found = _unfilled(points, rows)
    return canonical.zero_(), query.fill_(points.shape[0] * points.shape[1]), jacobian_inverse.zero_(), found.zero_()


def _nothing(points: Tensor, capacity: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _padding(points, capacity or 0)


def _check_limits(queries: int, cells: int) -> None:
    if queries >= _LIMIT:
        raise ValueError(f"points: wanted fewer than 2^31 on a GPU, got {queries}")
    if cells >= _LIMIT:
        raise ValueError(f"skinning_weights: wanted fewer than 2^31 grid cells on a GPU, got {cells}")
