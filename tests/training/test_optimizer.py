"""Adam with an average while a feature grid grows."""

from __future__ import annotations

import copy

import torch
from torch import nn
from toy_training import training_config

from snarfcli.shape.features import FeatureGrids
from snarfcli.training.optimizer import AveragedAdam


class Model(nn.Module):
    """A grid of features beside a plain parameter."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.plain = nn.Parameter(torch.ones(3))
        self.grids = FeatureGrids(torch.zeros(3), torch.ones(3), [0.25], 2)
        cells = torch.zeros(4, 4, 4, dtype=torch.bool)
        cells[0, 0, 0] = True
        self.grids.cover(cells)

    def loss(self) -> torch.Tensor:
        return (self.plain**2).sum() + (self.grids.table[:8] - 1).square().sum()


def steps(model: Model, optimizer: AveragedAdam, count: int, first: int = 0) -> None:
    for step in range(first, first + count):
        optimizer.zero_gradients()
        model.loss().backward()
        optimizer.step(0.01, step)


def test_features_have_a_rate_of_their_own():
    model = Model()
    optimizer = AveragedAdam(model, training_config(feature_rate=3.0))
    before = [parameter.detach().clone() for parameter in optimizer.parameters]
    steps(model, optimizer, 1)
    moved = [float((p.detach() - q).abs().max()) for p, q in zip(optimizer.parameters, before, strict=True)]
    assert abs(moved[0] - 0.01) < 1e-5  # the first step of Adam is as long as the rate
    assert abs(moved[1] - 0.03) < 1e-5


def test_growth_changes_nothing_about_the_rows_that_were_there():
    grown, plain = Model(), Model()
    optimizers = [AveragedAdam(model, training_config()) for model in (grown, plain)]
    for model, optimizer in zip((grown, plain), optimizers, strict=True):
        steps(model, optimizer, 3)
    assert grown.grids.cover() > 0
    optimizers[0].follow_growth()
    for model, optimizer in zip((grown, plain), optimizers, strict=True):
        steps(model, optimizer, 3, first=3)
    rows = len(plain.grids.table)
    assert torch.equal(grown.grids.table[:rows], plain.grids.table)
    assert torch.equal(optimizers[0].average[1][:rows], optimizers[1].average[1])
    assert len(optimizers[0].average[1]) == len(grown.grids.table) > rows
    assert torch.equal(optimizers[0].average[0], optimizers[1].average[0])


def test_a_grown_state_continues():
    first = Model()
    optimizer = AveragedAdam(first, training_config())
    steps(first, optimizer, 2)
    first.grids.cover()
    optimizer.follow_growth()
    steps(first, optimizer, 2, first=2)
    second = Model()
    second.load_state_dict(first.state_dict())
    other = AveragedAdam(second, training_config())
    other.restore(copy.deepcopy(optimizer.state()))  # as from a file
    for model, continued in ((first, optimizer), (second, other)):
        steps(model, continued, 2, first=4)
    for one, two in zip([*optimizer.parameters, *optimizer.average], [*other.parameters, *other.average], strict=True):
        assert torch.equal(one, two)
