"""Pose conditions of canonical points."""

from __future__ import annotations

import pytest
import torch

from snarfcli.shape import OccupancyNetwork, ShapeConfig, joints_of_bones

#        0
#       / \
#      1   3
#      |   |
#      2   4
PARENTS = (-1, 0, 1, 0, 3)
CONFIG = ShapeConfig(width=16, depth=3, skip_layers=[2], condition_layer=1, condition_size=4, frequencies=[2.0])


def network() -> OccupancyNetwork:
    torch.manual_seed(0)
    return OccupancyNetwork(CONFIG, 3 * (len(PARENTS) - 1), torch.zeros(1, 2, 3)).double()


def test_bones_see_the_joints_at_their_ends():
    seen = joints_of_bones(PARENTS)
    assert seen.shape == (5, 4)
    wanted = {0: [1, 3], 1: [1, 2], 2: [2], 3: [3, 4], 4: [4]}  # the root's own angles turn the whole body
    for bone, joints in wanted.items():
        assert (seen[bone].nonzero()[:, 0] + 1).tolist() == joints


def test_a_point_that_sees_all_parts_has_the_global_condition():
    random = torch.Generator().manual_seed(1)
    points, condition = torch.rand(30, 3, generator=random).double(), torch.randn(3, 12, generator=random).double()
    pose = torch.randint(3, (30,), generator=random)
    shape = network()
    torch.testing.assert_close(shape(points, condition, pose, torch.ones(30, 4).double()), shape(points, condition, pose))


def test_a_point_depends_only_on_the_parts_that_it_sees():
    random = torch.Generator().manual_seed(2)
    points, condition = torch.rand(20, 3, generator=random).double(), torch.randn(1, 12, generator=random).double()
    weights = torch.nn.functional.one_hot(torch.arange(20) % 5, 5).double()
    seen = weights @ joints_of_bones(PARENTS).double()
    shape, pose = network(), torch.zeros(20, dtype=torch.long)
    before = shape(points, condition, pose, seen)
    for joint in range(1, 5):
        changed = condition.clone()
        changed[:, 3 * joint - 3 : 3 * joint] += 1.0
        moved = (shape(points, changed, pose, seen) - before).abs() > 1e-9
        assert torch.equal(moved, seen[:, joint - 1] > 0)


def test_gradient_of_a_local_condition():
    random = torch.Generator().manual_seed(3)
    points = torch.rand(6, 3, generator=random).double().requires_grad_()
    condition = torch.randn(2, 12, generator=random).double().requires_grad_()
    seen = torch.rand(6, 4, generator=random).double()
    pose = torch.tensor([0, 1, 1, 0, 0, 1])
    assert torch.autograd.gradcheck(lambda x, c: network()(x, c, pose, seen), (points, condition))


@pytest.mark.parametrize("pose", [torch.tensor([2, 2, 0]), torch.zeros(0, dtype=torch.long)])
def test_any_order_of_poses(pose):
    shape = network()
    condition = torch.randn(3, 12, generator=torch.Generator().manual_seed(4)).double()
    points, seen = torch.rand(len(pose), 3).double(), torch.rand(len(pose), 4).double()
    only = torch.zeros(1, dtype=torch.long)
    each = [shape(points[i : i + 1], condition[p : p + 1], only, seen[i : i + 1]) for i, p in enumerate(pose)]
    wanted = torch.cat(each) if each else torch.zeros(0).double()
    torch.testing.assert_close(shape(points, condition, pose, seen), wanted)
