"""How evenly the kernels of the complete search share out their work, counted by the emulation, and their lists when full."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cuda_emulation import EmulatedGpu, host_compiler
from skinning_scenes import posed_queries, random_transforms, smooth_weights, unit_grid
from torch import Tensor

from snarfcli.deformer.skinning import blend_transforms
from snarfcli.native import cuda_launches

pytestmark = pytest.mark.skipif(host_compiler() is None, reason="needs a C++ compiler")

SHAPE = (12, 13, 14)
WARPS = 1056  # blocks of search_cells: a quarter of a large GPU, for a scene with a tenth of the usual queries
ROUNDS, HALVINGS, SOLVES = range(3)


@pytest.fixture(scope="module")
def crowded() -> tuple[Tensor, Tensor]:
    """Return 20,000 queries [1, N, 3], a third of them within two cells, and blended transforms with many folds."""
    weights = smooth_weights(SHAPE, 24, dtype=torch.float32)
    poses = random_transforms(1, 24, 0.4, dtype=torch.float32)
    points, _ = posed_queries(weights, poses[0], 20_000)
    points[:7000] = points[0] + 0.05 * (points[:7000] - points[0])
    return points[None], blend_transforms(weights, poses)


def search(
    launcher: EmulatedGpu, points: Tensor, transforms: Tensor, shape: tuple[int, int, int] = SHAPE
) -> tuple[Tensor, ...]:
    grid = unit_grid(points.dtype)
    settings = (None, 5e-6, 10, False, None)
    return cuda_launches.run_complete(launcher, points, transforms, grid.lower, grid.upper, shape, *settings)


@pytest.fixture(scope="module")
def work(crowded) -> dict[str, np.ndarray]:
    """Return what each block did, int64 [blocks, 2, 3], by kernel, with blocks of the size that they have on a GPU."""
    launcher = EmulatedGpu(torch.float32, block=128)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_launches, "_WARPS", WARPS)
        search(launcher, *crowded)
    return {kernel: np.concatenate(launches) for kernel, launches in launcher.work.items()}


def test_candidates_are_shared_out_evenly(work):
    """A third of the queries are candidates of the same few cells, which no block may have to itself."""
    rounds = work["search_cells"][:, 1, ROUNDS]
    assert rounds.sum() > 5 * WARPS  # enough to tell
    assert rounds.max() <= 3 * rounds.mean()
    assert work["search_cells"][:, 1, HALVINGS].max() <= 8  # one for each chunk


def test_no_thread_halves_or_solves_in_series(work):
    assert work["halve_parts"][:, 0, HALVINGS].sum() > 10_000
    assert work["solve_parts"][:, 0, SOLVES].sum() > 20_000
    for kernel, kind, each in (("halve_parts", HALVINGS, 4), ("solve_parts", SOLVES, 1)):
        busiest, blocks = work[kernel][:, 1], work[kernel]
        perfect = -(-blocks[:, 0, ROUNDS].sum() // (len(blocks) * 128))
        assert busiest[:, kind].max() <= each * (perfect + 1) + 4  # one item more, and one part of the last level


def test_nothing_is_left_over_where_the_lists_have_room(work):
    assert work["search_rest"].sum() == 0


@pytest.mark.parametrize("block", [1, 8])
@pytest.mark.parametrize("rooms", [[1] * 5, [50] * 5, [10_000, 500, 30, 3, 2], [10_000, 10_000, 1, 1, 1], [50, *[10_000] * 4]])
def test_lists_without_room_lose_no_root(rooms, block, monkeypatch):
    shape = (3, 4, 4)
    weights = smooth_weights(shape, 24, dtype=torch.float32)
    poses = random_transforms(2, 24, 0.8, dtype=torch.float32)
    points = torch.stack([posed_queries(weights, pose, 150, seed)[0] for seed, pose in enumerate(poses)])
    transforms = blend_transforms(weights, poses)
    monkeypatch.setattr(cuda_launches, "_WARPS", 6)
    wanted = search(EmulatedGpu(torch.float32, block), points, transforms, shape)
    assert len(wanted[1]) > 350
    monkeypatch.setattr(cuda_launches, "_rooms", lambda queries, slots: rooms)
    launcher = EmulatedGpu(torch.float32, block)
    found = search(launcher, points, transforms, shape)
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
    found_full = sum(part.sum() for part in launcher.work["search_rest"]) > 0
    assert found_full == (rooms[1] < 1000)  # no cell of this scene is tame


def test_cells_remain_whole_where_there_is_no_room_for_units(crowded, monkeypatch):
    points, transforms = crowded[0][:, :9000], crowded[1]
    monkeypatch.setattr(cuda_launches, "_WARPS", 30)
    wanted = search(EmulatedGpu(torch.float32), points, transforms)
    for cuts in (0, 1, 7):
        monkeypatch.setattr(cuda_launches, "_most_cuts", lambda count, cuts=cuts: cuts)
        found = search(EmulatedGpu(torch.float32), points, transforms)
        assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
