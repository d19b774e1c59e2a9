"""Active cells: what follows from them, also where its tensors keep their places."""

from __future__ import annotations

import copy

import pytest
import torch
from pretend_gpu.run import run_on_pretend_gpu
from skinning_scenes import random_transforms, unit_grid

from snarfcli.deformer import BonePrior, ForwardDeformer, SkinningConfig, field_on_grid
from snarfcli.draws import GeneratorDraws, HashedDraws

FIELDS = [("distilled", False), ("distilled", True), ("voxel", True)]


def deformer(name: str, with_prior: bool) -> ForwardDeformer:
    torch.manual_seed(0)
    skinning = SkinningConfig(name=name, resolution=[8, 7, 6], width=16, depth=2, weight_norm=False)
    prior = BonePrior(torch.rand(3, 2, 3), [0, 1, 2], 3, 0.1) if with_prior else None
    return ForwardDeformer(unit_grid(torch.float32), 3, skinning, prior=prior)


def some_cells(count: int) -> torch.Tensor:
    """Return the first `count` cells of the grid along z."""
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[:count] = True
    return cells


@pytest.mark.parametrize(("name", "with_prior"), FIELDS)
def test_with_room_for_more_cells_all_is_as_without(name, with_prior):
    plain, roomy = deformer(name, with_prior), deformer(name, with_prior)
    roomy.keep_room()
    transforms = random_transforms(2, 3, 0.3, dtype=torch.float32)
    points = torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(2))
    for count in (3, 2, 4, 1):
        results = []
        for one in (plain, roomy, copy.deepcopy(roomy)):
            one.set_active_cells(some_cells(count))
            weights = one.node_weights()
            found = one(points, transforms, weights=weights)
            gradients = torch.autograd.grad(found.canonical.sum() + one.smoothness(weights), list(one.field.parameters()))
            random = one.random_canonical(50, HashedDraws(0, torch.tensor(count), 1))
            assert one.is_active(random).all()
            results.append([weights.values, found.canonical, random, *gradients])
        for other in results[1:]:
            assert all(map(torch.equal, results[0][:3], other[:3]))
            for mine, theirs in zip(other[3:], results[0][3:], strict=True):
                torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)  # float32, sums with more zeros
    drawn = [one.random_canonical(50, GeneratorDraws.seeded(4)) for one in (plain, roomy)]
    assert torch.equal(*drawn)


def test_tensors_keep_their_places_until_they_are_too_short():
    one = deformer("distilled", with_prior=False)
    one.set_active_cells(some_cells(3))
    one.keep_room()

    def places() -> list[int]:
        return [buffer.data_ptr() for buffer in one.buffers() if buffer.numel()]

    before = places()
    for cells in (some_cells(2), some_cells(3), some_cells(1)):
        one.set_active_cells(cells)
        assert places() == before
    one.set_active_cells(some_cells(5))
    assert places() != before


def test_the_kept_prior_is_that_of_the_present_nodes():
    one = deformer("distilled", with_prior=True)
    one.keep_room()
    one.node_weights()
    one.set_active_cells(some_cells(1))
    fresh = deformer("distilled", with_prior=True)
    fresh.set_active_cells(some_cells(1))
    assert torch.equal(one.node_weights().values, fresh.node_weights().values)


def test_a_search_with_a_capacity_spares_the_wait():
    """Also with weights that are not evaluated before, and after the cells have changed."""
    code = """
    import torch
    from pretend_gpu.device import CUDA, watch
    from skinning_scenes import random_transforms, unit_grid

    from snarfcli.deformer import ForwardDeformer, PresetWeights, SkinningConfig

    grid = unit_grid(torch.float32)
    nodes = grid.nodes((3, 3, 12)).reshape(-1, 3)
    weights = (4 * torch.stack([-((nodes[:, 0] - c) ** 2) for c in (-0.5, 0.0, 0.5)], 1)).softmax(1)
    given = PresetWeights.from_vertices(nodes, weights, grid, (6, 7, 8))
    transforms = random_transforms(2, 3, 0.3, dtype=torch.float32).to(CUDA)
    points = torch.rand(2, 30, 3).to(CUDA)
    for name in ("distilled", "voxel", "preset"):
        skinning = SkinningConfig(name=name, resolution=[8, 7, 6], width=16, depth=2, weight_norm=False)
        deformer = ForwardDeformer(grid, 3, skinning, field=given if name == "preset" else None).to(CUDA)
        cells = torch.ones(5, 6, 7, dtype=torch.bool, device=CUDA)
        cells[0] = False
        deformer(points, transforms, capacity=100)  # makes the constants
        deformer.set_active_cells(cells)
        with watch(name):
            found = deformer(points, transforms, capacity=100)
            found.blend(found.canonical[:, 0], 1.0, 0.0)
            found.maximum(found.canonical[:, 0], 0.0), found.counts, found.padded(slots=4)
    """
    report = run_on_pretend_gpu(code)
    for name in ("distilled", "voxel", "preset"):
        assert (report[name].waits, report[name].copies, report[name].mixing) == ([], [], [])


def test_what_a_captured_step_reads_of_the_prior_stays_in_its_place(monkeypatch):
    one = deformer("distilled", with_prior=True)
    one.set_active_cells(some_cells(3))
    one.keep_room()
    one.node_weights(active_only=True)
    kept = one.field._last
    assert kept[0] is one._active_points
    whole = one.weight_grid()  # at other points
    monkeypatch.setattr(field_on_grid, "_VALUES_AT_ONCE", 1000)
    with torch.no_grad():
        torch.testing.assert_close(one.node_weights(active_only=True).values[:4], whole[:4])  # in parts
    assert one.field._last is kept
    one.set_active_cells(some_cells(2))
    one.node_weights(active_only=True)
    assert one.field._last is not kept
