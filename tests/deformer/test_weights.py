"""The weight fields: what they start from, what they interpolate, and the loss that keeps voxels smooth."""

from __future__ import annotations

import pytest
import torch
from skinning_scenes import unit_grid

from snarfcli.deformer import BonePrior, CanonicalGrid
from snarfcli.deformer.hierarchy import HierarchicalSoftmax, PlainSoftmax
from snarfcli.deformer.trilinear import interpolate
from snarfcli.deformer.variation import total_variation, variation, variation_reference
from snarfcli.deformer.weights import NetworkWeights, VoxelWeights
from snarfcli.native import cpu

PARENTS = [-1, 0, 1, 0]
SHAPE = (4, 5, 6)
SOFTMAXES = {"plain": lambda: PlainSoftmax(4), "hierarchical": lambda: HierarchicalSoftmax(PARENTS)}


def prior() -> BonePrior:
    joints = torch.tensor([[0.0, 0, 0], [0, 0.5, 0], [0, 0.9, 0], [0.5, 0, 0]], dtype=torch.float64)
    segments = torch.stack([joints[[0, 1]], joints[[1, 2]], joints[[2, 2]], joints[[3, 3]]])
    return BonePrior(segments, [0, 1, 2, 3], 4, 0.1)


def places(count: int = 200) -> torch.Tensor:
    grid = unit_grid()
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return grid.lower + share * (grid.upper - grid.lower)


@pytest.mark.parametrize("softmax", SOFTMAXES.values(), ids=SOFTMAXES.keys())
@pytest.mark.parametrize("kind", ["network", "voxel"])
def test_fields_are_weights_and_start_from_the_prior(kind, softmax):
    torch.manual_seed(0)
    softmax, bones, points = softmax(), prior(), places()
    if kind == "network":
        field = NetworkWeights(softmax, unit_grid(), 16, 2, 20.0, True, bones).double()
        wanted = bones(points).softmax(-1)
    else:
        field = VoxelWeights(softmax, unit_grid(), SHAPE, 20.0, bones)
        nodes = unit_grid().nodes(SHAPE).reshape(-1, 3)
        wanted = interpolate(bones(nodes).softmax(-1).reshape(*SHAPE, 4), points, unit_grid())
    weights = field(points)
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(points), dtype=torch.float64))
    torch.testing.assert_close(weights, wanted, atol=2e-2, rtol=0)  # the network's last layer starts at 1e-4


@pytest.mark.parametrize("softmax", SOFTMAXES.values(), ids=SOFTMAXES.keys())
def test_voxels_start_from_zero_logits_without_a_prior(softmax):
    field = VoxelWeights(softmax(), unit_grid(), SHAPE, 20.0)
    assert not bool(field.logits.any())
    torch.testing.assert_close(field(places()), field.at_nodes(torch.tensor([0])).expand(200, -1))


def test_voxels_are_trained_through_interpolation():
    """A loss on the weights at a joint, between the nodes, reaches the eight nodes around it and no others."""
    field = VoxelWeights(PlainSoftmax(4), unit_grid(), SHAPE, 20.0)
    joint = torch.tensor([[0.05, 0.02, 0.01]], dtype=torch.float64)
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-2)
    wanted = torch.tensor([[0.5, 0.5, 0.0, 0.0]], dtype=torch.float64)
    for _ in range(200):
        optimizer.zero_grad()
        (field(joint) - wanted).square().mean().backward()
        optimizer.step()
    torch.testing.assert_close(field(joint), wanted, atol=2e-2, rtol=0)
    assert int((field.logits != 0).any(1).sum()) == 8


def test_gradcheck_of_voxels():
    field = VoxelWeights(HierarchicalSoftmax(PARENTS), unit_grid(), (2, 2, 3), 2.0, prior())
    points = places(3)

    def weights(logits):
        return torch.func.functional_call(field, {"logits": logits}, points)

    assert torch.autograd.gradcheck(weights, field.logits.detach().clone().requires_grad_())


def ramp(shape):
    """Weights of two bones that change by 0.3 a metre along x and by 0.1 along z."""
    nodes = unit_grid().nodes(shape)
    first = 0.5 + 0.3 * nodes[..., 0] - 0.1 * nodes[..., 2]
    return torch.stack([first, 1 - first], -1)


@pytest.mark.parametrize("shape", [(2, 2, 2), (3, 4, 5), (9, 7, 17)])
def test_total_variation_of_a_ramp(shape):
    wanted = torch.tensor(2 * 0.3 + 2 * 0.1, dtype=torch.float64)
    torch.testing.assert_close(total_variation(ramp(shape), unit_grid()), wanted)
    used = torch.ones(shape, dtype=torch.bool)
    torch.testing.assert_close(total_variation(ramp(shape), unit_grid(), used), wanted)


def test_total_variation_reads_used_nodes_only():
    weights = ramp((3, 4, 5))
    used = torch.ones(3, 4, 5, dtype=torch.bool)
    used[0], used[:, 2, 3] = False, False
    wanted = total_variation(weights, unit_grid(), used)
    weights[0], weights[:, 2, 3] = 100.0, -7.0
    torch.testing.assert_close(total_variation(weights, unit_grid(), used), wanted)
    assert float(total_variation(weights, unit_grid(), torch.zeros_like(used))) == 0


@pytest.mark.parametrize("kind", ["network", "voxel"])
def test_another_box_moves_the_field(kind):
    torch.manual_seed(0)
    small = CanonicalGrid(torch.zeros(3), torch.ones(3))
    large = CanonicalGrid(torch.full((3,), -2.0), torch.full((3,), 2.0))
    if kind == "network":
        field = NetworkWeights(PlainSoftmax(4), small, 16, 2, 20.0, False)
    else:
        field = VoxelWeights(PlainSoftmax(4), small, SHAPE, 20.0)
        torch.nn.init.normal_(field.logits, 0, 0.1)
    share = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    before = field(share)
    field.set_box(large)
    torch.testing.assert_close(field(large.lower + share * 4), before, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("shape", [(2, 2, 2, 1), (3, 5, 4, 7), (1, 4, 9, 24), (8, 32, 32, 24)])
@pytest.mark.parametrize("share", [None, 0.0, 0.6, 1.0])
def test_native_variation_equals_the_reference(shape, share):
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(shape, generator=generator)
    used = None if share is None else torch.rand(shape[:3], generator=generator) < share
    size = torch.tensor([0.1, 0.2, 0.05])
    given = weights.double().requires_grad_()
    wanted = variation_reference(given, size, used)
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(cpu.total_variation(weights, size, used))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
    torch.testing.assert_close(results[0][0].double(), wanted.detach(), rtol=1e-5, atol=0)
    torch.testing.assert_close(results[0][1].double(), torch.autograd.grad(wanted, given)[0], rtol=1e-5, atol=1e-9)


def test_variation_is_an_operator():
    weights = torch.rand(3, 4, 5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    used = torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(1)) < 0.7
    size = torch.tensor([0.1, 0.2, 0.3])
    assert torch.autograd.gradcheck(lambda given: variation(given, size, used)[0], [weights])
    torch.library.opcheck(variation, (weights.detach().float(), size, used))


@pytest.mark.parametrize("softmax", [PlainSoftmax(4), HierarchicalSoftmax(PARENTS)])
def test_extended_weights_are_means_of_their_neighbours(softmax):
    field = VoxelWeights(softmax, unit_grid(), (5, 6, 7), sharpness=5.0)
    with torch.no_grad():
        field.logits.normal_(generator=torch.Generator().manual_seed(0))
    before = field.at_nodes().detach().reshape(5, 6, 7, 4)
    kept = torch.zeros(5, 6, 7, dtype=torch.bool)
    kept[2, 2:4, 3] = kept[0, 0, 0] = True
    field.extend_from(kept)
    after = field.at_nodes().detach().reshape(5, 6, 7, 4)
    assert torch.equal(after[kept], before[kept])
    torch.testing.assert_close(after.sum(-1), torch.ones_like(after[..., 0]))
    conductance = [1 / size**2 for size in unit_grid().cell_size((5, 6, 7)).tolist()]  # x, y, z
    inner, around, total = after[1:-1, 1:-1, 1:-1], 0.0, 0.0
    for axis, flow in zip((2, 1, 0), conductance, strict=True):
        for start in (0, 2):
            shifted = [slice(start, after.shape[a] - 2 + start) if a == axis else slice(1, -1) for a in range(3)]
            around, total = around + flow * after[tuple(shifted)], total + flow
    free = ~kept[1:-1, 1:-1, 1:-1]
    assert float((inner - around / total)[free].abs().max()) < 0.02
    assert float((before - after).abs()[~kept].mean()) > 0.1
