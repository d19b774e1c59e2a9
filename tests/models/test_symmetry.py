"""Skeletons that are symmetric, and weights that are the same on both sides."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from snarfcli.bodies import Skeleton, builtin_body
from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.hierarchy import make_softmax
from snarfcli.deformer.weights import VoxelWeights
from snarfcli.models.symmetry import find_mirror


@pytest.fixture(scope="module")
def skeleton() -> Skeleton:
    body = builtin_body()
    return body.skeleton(torch.zeros(body.num_betas))


def test_a_body_is_symmetric_where_it_stands(skeleton):
    moved = replace(skeleton, joints_rest=skeleton.joints_rest + torch.tensor([0.3, 0, 0]))
    mirror = find_mirror(moved)
    assert mirror is not None
    assert mirror.bones == skeleton.left_right
    assert mirror.plane == pytest.approx(0.3, abs=0.005)
    points = torch.tensor([[-0.5, -1, -0.2], [0.9, 1, 0.2]])
    assert not mirror.maps_to_itself(CanonicalGrid.around(points, [0, 0, 0]))
    box = CanonicalGrid.around(mirror.complete(points), [0, 0, 0])
    assert mirror.maps_to_itself(box)
    assert box.lower.tolist() == pytest.approx([-0.5, -1, -0.2])
    assert box.upper.tolist() == pytest.approx([1.1, 1, 0.2], abs=0.01)


@pytest.mark.parametrize("form", ["{0}_{1}", "{1}.{0}", "{1}_{2}_tip", "{2}{1}", "DEF-{1}.{3}.001", "{0}Up{1}"])
def test_sides_are_known_in_any_spelling(skeleton, form):
    sides = {"l": ("l", "Left", "L"), "r": ("r", "Right", "R")}
    names = [
        form.format(name[0], name[2:].title(), *sides[name[0]][1:]) if name[:2] in ("l_", "r_") else name
        for name in skeleton.names
    ]
    assert len(set(names)) == len(names)
    assert replace(skeleton, names=tuple(names)).left_right == skeleton.left_right


def test_a_skeleton_without_counterparts_is_not(skeleton):
    bent = skeleton.joints_rest.clone()
    bent[skeleton.names.index("l_hand")] += torch.tensor([0.0, 0.2, 0.0])
    assert find_mirror(replace(skeleton, joints_rest=bent)) is None
    names = tuple(f"joint_{number}" for number in range(24))
    assert find_mirror(replace(skeleton, names=names)) is None
    root = Skeleton(("root",), (-1,), torch.zeros(1, 3), torch.zeros(1, 3))
    assert find_mirror(root) is None


@pytest.mark.parametrize(("kind", "width"), [("plain", 6), ("plain", 5), ("hierarchical", 4)])
def test_weights_at_mirrored_places_are_those_of_the_mirrored_bones(kind, width):
    grid = CanonicalGrid(torch.tensor([-1.0, 0, 0]), torch.tensor([1.0, 1, 1]))
    mirror = [0, 2, 1]
    torch.manual_seed(0)
    field = VoxelWeights(make_softmax(kind, 3, [-1, 0, 0]), grid, (3, 4, width), 2.0, mirror=mirror)
    torch.nn.init.normal_(field.logits)
    points = torch.rand(50, 3) * torch.tensor([2.0, 1, 1]) - torch.tensor([1.0, 0, 0])
    weights = field(points)
    torch.testing.assert_close(weights.sum(1), torch.ones(50))
    torch.testing.assert_close(field(points * torch.tensor([-1.0, 1, 1])), weights[:, mirror])
    some = torch.tensor([[0, 7], [33, 12 * width - 1]])
    torch.testing.assert_close(field.at_nodes(some), field.at_nodes()[some])
    assert (weights[:, 1] - weights[:, 2]).abs().max() > 0.1


def test_weights_below_the_middle_are_those_without_symmetry():
    grid = CanonicalGrid(torch.tensor([-1.0, 0, 0]), torch.tensor([1.0, 1, 1]))
    torch.manual_seed(0)
    plain = VoxelWeights(make_softmax("plain", 3, None), grid, (3, 4, 6), 2.0)
    torch.nn.init.normal_(plain.logits)
    field = VoxelWeights(make_softmax("plain", 3, None), grid, (3, 4, 6), 2.0, mirror=[0, 2, 1])
    with torch.no_grad():
        field.logits.copy_(field.optimised(plain.logits.reshape(3, 4, 6, 3)).reshape(-1, 3))
    torch.testing.assert_close(field.at_nodes().reshape(3, 4, 6, 3)[:, :, :3], plain.at_nodes().reshape(3, 4, 6, 3)[:, :, :3])


def test_extended_weights_keep_the_symmetry():
    grid = CanonicalGrid(torch.tensor([-1.0, 0, 0]), torch.tensor([1.0, 1, 1]))
    field = VoxelWeights(make_softmax("plain", 3, None), grid, (3, 3, 6), 1.0, mirror=[0, 2, 1])
    torch.nn.init.normal_(field.logits)
    kept = torch.zeros(3, 3, 6, dtype=torch.bool)
    kept[1, 1, 0] = kept[0, 1, 4] = True
    before, logits = field.at_nodes().reshape(3, 3, 6, 3), field.logits.detach().clone()
    changed = field.extend_from(kept)
    after = field.at_nodes().reshape(3, 3, 6, 3)
    torch.testing.assert_close(after[kept], before[kept])
    torch.testing.assert_close(after.flip(2)[..., [0, 2, 1]], after)
    assert (field.logits != logits).any(1).tolist() == changed.tolist()
    assert changed.sum() == 3 * 3 * 3 - 2


def test_gradients_come_from_both_sides():
    grid = CanonicalGrid(torch.tensor([-1.0, 0, 0]), torch.tensor([1.0, 1, 1]))
    field = VoxelWeights(make_softmax("plain", 3, None), grid, (2, 2, 4), 1.0, mirror=[0, 2, 1]).double()
    torch.nn.init.normal_(field.logits)
    points = field.lower + (field.upper - field.lower) * torch.rand(4, 3).double()

    def of_logits(logits: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(field, {"logits": logits}, (points,))

    assert torch.autograd.gradcheck(of_logits, (field.logits.detach().clone().requires_grad_(),))
    field.at_nodes(torch.tensor([1, 7]))[:, 1].sum().backward()
    assert field.logits.grad.abs().sum(1).nonzero()[:, 0].tolist() == [1, 2]  # the last node of a row is the image of the first
