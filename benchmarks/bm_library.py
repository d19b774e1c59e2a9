"""What a project with its own networks and losses pays for the deformer: prepared poses, frozen weights, weights at points.

    python benchmarks/bm_library.py                                   about ten minutes on two cores
    python benchmarks/bm_library.py --points 100000 --repeats 1       a minute
    python benchmarks/bm_library.py --only chunks,frozen              some parts: chunks, frozen, weights, skinning, vertices

The built-in body with 24 bones in a pose with random joints. Everything that is compared is timed in turns, so that the ratios
hold on a busy machine too; ratios are of elapsed and, in brackets, of processor time.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from common import Times, arguments, in_turns, print_machine, print_table, resident_bytes
from torch import Tensor

from snarfcli import ForwardDeformer, builtin_body
from snarfcli.deformer import PresetWeights, skin

_PARTS = ("chunks", "frozen", "weights", "skinning", "vertices")
_RESOLUTIONS = ((64, 64, 16), (128, 128, 32))
_SAMPLES = 64  # of a ray, from the front of the body's box to its back
_MARGIN_M = 0.1  # of the posed body's box
_POSES_KEPT = 8  # to measure the memory of one
_KINDS = ("rays, body's box", "random, body's box", "random, whole grid")


def main() -> None:
    options = arguments(
        "The deformer as a library.",
        points={"type": int, "default": 1_000_000, "help": "number of points of a pose"},
        chunk={"type": int, "default": 5000, "help": "points of a call, for the pose in chunks"},
        part={"type": int, "default": 10, "help": "number of chunks that are timed without a prepared pose"},
        only={"default": ",".join(_PARTS), "help": f"parts to run, of {', '.join(_PARTS)}"},
    )
    torch.set_num_threads(options.threads or 2)
    print_machine()
    print(f"{torch.get_num_threads()} threads; load of the machine {os.getloadavg()[1]:.1f} before")
    works: dict[str, Callable[[], None]] = {
        "chunks": lambda: _chunks(options.points, options.chunk, options.part, options.repeats),
        "frozen": lambda: _frozen(options.repeats),
        "weights": lambda: _weights(options.repeats),
        "skinning": lambda: _skinning(options.repeats),
        "vertices": lambda: _vertices(options.repeats),
    }
    for name in options.only.split(","):
        works[name]()
    print(f"\nLoad of the machine with this benchmark {os.getloadavg()[1]:.1f}")


# ---------------------------------------------------------------- scenes
@lru_cache(maxsize=4)
def _deformer(resolution: tuple[int, int, int], trainable: bool) -> ForwardDeformer:
    """Return a deformer of the built-in body, with fixed or trained weights at the nodes."""
    return ForwardDeformer.from_body(builtin_body(), resolution=resolution, trainable=trainable)


def _transforms(deformer: ForwardDeformer, batch: int) -> Tensor:
    """Return the bone transforms [B, J, 4, 4] of poses with random joints."""
    assert deformer.body is not None
    poses = 0.35 * torch.randn(batch, deformer.num_bones, 3, generator=torch.Generator().manual_seed(0))
    return deformer.body.posed_from_canonical(poses)


def _random(lower: Tensor, upper: Tensor, count: int) -> Tensor:
    """Return points [count, 3] spread evenly in a box."""
    return lower + (upper - lower) * torch.rand(count, 3, generator=torch.Generator().manual_seed(1))


def _camera_rays(lower: Tensor, upper: Tensor, count: int) -> Tensor:
    """Return at most `count` points [N, 3] along the rays of a camera 3 m in front of a box, ray after ray."""
    middle, sides = (lower + upper) / 2, upper - lower
    across = torch.linspace(-0.5, 0.5, math.isqrt(count // _SAMPLES))
    pixels = torch.cartesian_prod(across, across, torch.zeros(1)) * sides
    eye = torch.tensor([0.3, 0.2, 3.0])  # from the middle
    rays = pixels - eye
    first, last = ((side - middle - eye)[2] / rays[:, 2] for side in (upper, lower))
    share = torch.linspace(0, 1, _SAMPLES)
    depths = first[:, None] + (last - first)[:, None] * share
    return (middle + eye + rays[:, None] * depths[..., None]).reshape(-1, 3)


def _queries(deformer: ForwardDeformer, transforms: Tensor, kind: str, count: int) -> Tensor:
    """Return posed points [1, N, 3] of one of `_KINDS`."""
    assert deformer.body is not None
    with torch.no_grad():
        if kind == "random, whole grid":
            return deformer.skin(_random(deformer.lower, deformer.upper, count)[None], transforms)
        posed = deformer.skin(deformer.body.vertices[None], transforms)[0]
    lower, upper = posed.amin(0) - _MARGIN_M, posed.amax(0) + _MARGIN_M
    return (_camera_rays if kind.startswith("rays") else _random)(lower, upper, count)[None]


# ---------------------------------------------------------------- prepared poses
def _chunks(count: int, chunk: int, part: int, repeats: int) -> None:
    """Compare a prepared pose in chunks with one call, and with chunks without a prepared pose."""
    rows = []
    for trainable in (False, True):
        for resolution in _RESOLUTIONS:
            for cells in ("near", "all"):
                deformer = copy.deepcopy(_deformer(resolution, trainable))
                if cells == "all":
                    deformer.set_active_cells(torch.ones_like(deformer.active_cells))
                if not trainable:
                    deformer.freeze()
                case = ["forward + backward" if trainable else "forward", _size(resolution), cells]
                transforms = _transforms(deformer, 1)
                for kind in _KINDS:
                    points = _queries(deformer, transforms, kind, count)
                    rows.append([*case, kind, *_pose_row(deformer, transforms, points, chunk, part, repeats)])
    header = ["pass", "grid", "cells", "points", "roots per point", "one call, ms", "in chunks / one call"]
    header += ["without a prepared pose / one call", "pose, ms"]
    print(f"\nA pose of {count:,} points in calls of {chunk:,}. `in chunks` includes the preparation of the pose.\n")
    print_table(header, rows)
    print("\nMemory of a prepared pose, forward only, all cells:\n")
    print_table(["grid", "MB"], [[_size(resolution), f"{_memory_of_a_pose(resolution):.0f}"] for resolution in _RESOLUTIONS])


def _pose_row(deformer: ForwardDeformer, transforms: Tensor, points: Tensor, chunk: int, part: int, repeats: int) -> list[str]:
    chunks = points.split(chunk, 1)
    some = chunks[:: max(1, len(chunks) // part)]  # all along the rays
    trains = any(parameter.requires_grad for parameter in deformer.parameters())
    roots = 0

    def finish(loss: Tensor) -> None:
        deformer.zero_grad(set_to_none=True)
        loss.backward()

    def whole() -> None:
        nonlocal roots
        found = deformer(points, transforms)
        roots = len(found.query)
        if trains:
            finish(found.canonical.square().sum())

    def in_chunks() -> None:
        posed = deformer.pose(transforms)
        if trains:
            finish(torch.stack([posed(few).canonical.square().sum() for few in chunks]).sum())
        else:
            for few in chunks:
                posed(few)

    def unprepared() -> None:
        for few in some:
            found = deformer(few, transforms)
            if trains:
                finish(found.canonical.square().sum())

    with torch.set_grad_enabled(trains):
        one, chunked, former, pose = in_turns([whole, in_chunks, unprepared, lambda: deformer.pose(transforms)], repeats)
    former = former.scaled(len(chunks) / len(some))
    return [f"{roots / points.shape[1]:.2f}", _ms(one), chunked.over(one), former.over(one), _ms(pose)]


def _memory_of_a_pose(resolution: tuple[int, int, int]) -> float:
    """Return by how many megabytes a prepared pose makes the process grow; all cells are searched."""
    deformer = copy.deepcopy(_deformer(resolution, False))
    deformer.set_active_cells(torch.ones_like(deformer.active_cells))
    deformer.freeze()
    transforms = _transforms(deformer, 1)
    kept = [deformer.pose(transforms)]  # the first one also takes what all of them use in passing
    before = resident_bytes()
    kept += [deformer.pose(transforms) for _ in range(_POSES_KEPT)]
    return (resident_bytes() - before) / (len(kept) - 1) / 1e6


# ---------------------------------------------------------------- weights
def _frozen(repeats: int) -> None:
    """Compare a frozen weight network with one that each call evaluates at the nodes."""
    body = _deformer(_RESOLUTIONS[0], False)
    thawed = ForwardDeformer(body.grid, body.num_bones, active_cells=body.active_cells).eval()
    frozen = copy.deepcopy(thawed).freeze().eval()
    transforms = _transforms(body, 1)
    rows = []
    for kind in _KINDS[:2]:
        points = _queries(body, transforms, kind, 10_000)
        with torch.no_grad():
            times = in_turns([lambda: frozen(points, transforms), lambda: thawed(points, transforms)], 4 * repeats)  # noqa: B023
        rows.append([kind, *map(_ms, times), times[1].over(times[0])])
    print(f"\nA distilled weight network, the nodes of {_size(_RESOLUTIONS[0])} near the body, 10,000 points, no gradients:\n")
    print_table(["points", "frozen, ms", "not frozen, ms", "not frozen / frozen"], rows)


def _weights(repeats: int) -> None:
    """Compare the weights at 2,000 points with those of the whole grid, in training with a backward pass."""
    body = _deformer(_RESOLUTIONS[0], True)
    fields = {"distilled": ForwardDeformer(body.grid, body.num_bones), "voxel": copy.deepcopy(body)}
    fields["voxel, 128 x 128 x 32"] = copy.deepcopy(_deformer(_RESOLUTIONS[1], True))
    points = _random(body.lower, body.upper, 2000)
    rows = []
    for name, deformer in fields.items():

        def finish(weights: Tensor, deformer: ForwardDeformer = deformer) -> None:
            deformer.zero_grad(set_to_none=True)
            weights.square().sum().backward()

        def at_points(deformer: ForwardDeformer = deformer, finish: Callable[[Tensor], None] = finish) -> None:
            finish(deformer.skinning_weights(points))

        def of_grid(deformer: ForwardDeformer = deformer, finish: Callable[[Tensor], None] = finish) -> None:
            finish(deformer.skinning_weights(points, deformer.node_weights(active_only=False)))

        times = in_turns([at_points, of_grid], repeats)
        rows.append([name, *map(_ms, times), times[1].over(times[0])])
    print("\nWeights at 2,000 points in training, forward and backward:\n")
    print_table(["field", "nodes around them, ms", "whole grid, ms", "whole grid / around them"], rows)


# ---------------------------------------------------------------- skinning and vertices
def _skinning(repeats: int) -> None:
    """Compare ways to move the same points into several poses."""
    deformer = copy.deepcopy(_deformer(_RESOLUTIONS[0], False)).freeze()
    assert isinstance(deformer, ForwardDeformer)
    batch, count = 8, 20_000
    transforms = _transforms(deformer, batch)
    points = _random(deformer.lower, deformer.upper, count).expand(batch, -1, -1).contiguous()
    vectors = torch.nn.functional.normalize(points, dim=-1)
    flat = points.reshape(-1, 3)
    weights = deformer.skinning_weights(points[0])
    posed = deformer.pose(transforms)
    works: dict[str, Callable[[], object]] = {
        "deformer.skin, all poses at once": lambda: deformer.skin(points, transforms),
        "deformer.skin, pose by pose": lambda: [deformer.skin(*pair) for pair in zip(points, transforms, strict=True)],
        "posed.skin": lambda: posed.skin(points),
        "posed.skin with directions and normals": lambda: posed.skin(points, directions=vectors, normals=vectors),
        "skin with deformer.skinning_weights": lambda: skin(
            points, deformer.skinning_weights(flat).view(batch, count, -1), transforms
        ),
        "skin with known weights": lambda: skin(points, weights, transforms),
    }
    with torch.no_grad():
        times = in_turns(list(works.values()), repeats)
    rows = [[name, _ms(one), one.over(times[0])] for name, one in zip(works, times, strict=True)]
    print(f"\n{count:,} points in {batch} poses, without gradients, {_size(_RESOLUTIONS[0])} nodes:\n")
    print_table(["call", "ms", "/ first"], rows)


def _vertices(repeats: int) -> None:
    """Time the extension of a body's weights from its vertices to the nodes."""
    body = _deformer(_RESOLUTIONS[0], False).body
    assert body is not None
    rows = []
    for resolution in _RESOLUTIONS:
        shape = (resolution[2], resolution[1], resolution[0])
        (times,) = in_turns([lambda: PresetWeights.from_vertices(body.vertices, body.weights, body.grid, shape)], repeats)  # noqa: B023
        rows.append([_size(resolution), f"{times.wall:.2f}", f"{times.processor:.2f}"])
    print(f"\nPresetWeights.from_vertices, {len(body.vertices):,} vertices:\n")
    print_table(["nodes", "s", "processor time, s"], rows)


def _size(resolution: Sequence[int]) -> str:
    return " x ".join(map(str, resolution))


def _ms(times: Times) -> str:
    return f"{1000 * times.wall:.3g} ({1000 * times.processor:.3g})"


if __name__ == "__main__":
    main()
