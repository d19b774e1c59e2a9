"""The losses against their definitions."""

from __future__ import annotations

import math

import pytest
import torch

from snarfcli.draws import GeneratorDraws
from snarfcli.training.losses import joint_weight_targets, occupancy_loss, points_on_bones


def test_occupancy_loss_is_the_cross_entropy_of_found_points():
    logits = torch.tensor([[0.3, -2.0, 5.0, -30.0]])
    occupied = torch.tensor([[True, False, False, True]])
    found = torch.tensor([[True, True, True, False]])

    def entropy(logit, inside):
        p = 1 / (1 + math.exp(-logit))
        return -math.log(p if inside else 1 - p)

    wanted = (entropy(0.3, True) + entropy(-2.0, False) + entropy(5.0, False)) / 4
    assert float(occupancy_loss(logits, occupied, found)) == pytest.approx(wanted, rel=1e-5)


def test_lost_points_have_no_gradient():
    logits = torch.zeros(1, 3, requires_grad=True)
    found = torch.tensor([[True, False, True]])
    occupancy_loss(logits, torch.ones(1, 3, dtype=torch.bool), found).backward()
    assert logits.grad[0, 1] == 0
    assert bool((logits.grad[0, [0, 2]] < 0).all())


@pytest.mark.parametrize(
    ("target", "last"),
    [("halves", [0.0, 0.5, 0.5]), ("parent", [0.0, 1.0, 0.0]), ("own", [0.0, 0.0, 1.0])],
)
def test_joint_weight_targets(target, last):
    wanted = joint_weight_targets([-1, 0, 1], target)
    assert wanted[0].tolist() == [1.0, 0.0, 0.0]
    assert wanted[2].tolist() == last
    assert wanted.sum(1).tolist() == [1.0] * 3


def test_unknown_joint_target_is_rejected():
    with pytest.raises(ValueError, match=r"training.joint_target: wanted one of halves, parent, own, got 'both'"):
        joint_weight_targets([-1], "both")


def test_points_lie_on_their_bones():
    bones = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]], [[1.0, 0, 0], [1.0, 2.0, 0]]])
    points = points_on_bones(bones, 50, GeneratorDraws.seeded(0)).reshape(2, 50, 3)
    assert bool((points[0, :, 1:] == 0).all())
    assert bool(((points[0, :, 0] >= 0) & (points[0, :, 0] <= 1)).all())
    assert bool((points[1, :, 0] == 1).all())
    assert float(points[1, :, 1].std()) > 0.3
