"""Adam with an average while a feature grid grows."""

from __future__ import annotations

import copy
import itertools
import math

import pytest
import torch
from torch import nn
from toy_training import training_config

from snarfcli.native.cpu_optimizer import adam_step
from snarfcli.shape.features import FeatureGrids
from snarfcli.training.optimizer import AveragedAdam, adam_step_reference


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


def arrays(seed: int, dtype: torch.dtype = torch.float32) -> list[list[torch.Tensor]]:
    """Values, gradients, both moments and averages of parameters of odd sizes; a tenth of the rows have gradients."""
    generator = torch.Generator().manual_seed(seed)
    shapes = [(), (3,), (17, 5), (40_001, 4), (0, 4)]
    made = [[torch.randn(shape, generator=generator).to(dtype) for shape in shapes] for _ in range(5)]
    made[1][3][torch.rand(40_001, generator=generator) > 0.1] = 0
    made[3] = [second.abs() for second in made[3]]
    return made


def native_step(given: list[list[torch.Tensor]], threads: int) -> float:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return adam_step(*given, *SETTINGS)
    finally:
        torch.set_num_threads(before)


SETTINGS = ([1e-2, 1e-2, 3e-2, 1e-2, 1e-2], [False, False, False, True, True], 7, (0.9, 0.999), 1e-8, 0.9)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_native_step_equals_the_reference(threads):
    native, wanted = arrays(0), arrays(0, torch.float64)
    total = native_step(native, threads)
    assert total == pytest.approx(adam_step_reference(*wanted, *SETTINGS), rel=1e-6)
    for mine, theirs in zip(itertools.chain(*native), itertools.chain(*wanted), strict=True):
        torch.testing.assert_close(mine, theirs.float(), rtol=2e-5, atol=2e-6)
    untouched = (native[1][3] == 0).all(1)
    assert 0.8 < untouched.float().mean() < 0.95
    start = arrays(0)
    for kind in (0, 2, 3):
        assert torch.equal(native[kind][3][untouched], start[kind][3][untouched])
    assert not torch.equal(native[4][3][untouched], start[4][3][untouched])  # the average follows all the same


def test_bits_do_not_depend_on_the_number_of_threads():
    results = []
    for threads in (1, 2, 3):
        given = arrays(1)
        results.append([native_step(given, threads), given])
    assert results[0][0] == results[1][0] == results[2][0]
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(itertools.chain(*results[0][1]), itertools.chain(*other[1]), strict=True))


def test_the_reference_is_adam():
    value = torch.linspace(-1, 1, 12).reshape(4, 3)
    theirs = nn.Parameter(value.clone())
    adam = torch.optim.Adam([theirs], lr=0.02)
    state = [torch.zeros(4, 3), torch.zeros(4, 3), value.clone()]
    for step in range(1, 6):
        gradient = torch.sin(step * torch.arange(12.0)).reshape(4, 3)
        theirs.grad = gradient.clone()
        adam.step()
        adam_step_reference([value], [gradient], *[[s] for s in state], [0.02], [False], step, (0.9, 0.999), 1e-8, 0.5)
    torch.testing.assert_close(value, theirs.detach())


@pytest.mark.parametrize("run", [adam_step_reference, adam_step])
@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_changes_nothing(run, wrong):
    given, before = arrays(2), arrays(2)
    given[1][3][-1, -1] = wrong
    assert not math.isfinite(run(*given, *SETTINGS))
    for kind in (0, 2, 3, 4):
        assert all(torch.equal(a, b) for a, b in zip(given[kind], before[kind], strict=True))


def test_rows_with_new_values_start_afresh():
    model = Model()
    optimizer = AveragedAdam(model, training_config())
    steps(model, optimizer, 3)
    table = model.grids.table
    rows = torch.zeros(len(table), dtype=torch.bool)
    rows[[1, 4]] = True
    with torch.no_grad():
        table[rows] = 7.0
    kept = optimizer.average[1][~rows].clone()
    optimizer.restart(table, rows)
    assert (optimizer.average[1][rows] == 7).all()
    assert torch.equal(optimizer.average[1][~rows], kept)
    moments = optimizer.state()["optimizer"]
    for name in ("first", "second"):
        assert (moments[name][1][rows] == 0).all()
        assert (moments[name][1][:4][~rows[:4]] != 0).any()


def test_arrays_that_do_not_fit_are_refused():
    given = arrays(0)
    given[2][3] = given[2][3][:-1]
    with pytest.raises(ValueError, match=r"parameter 3: wanted contiguous float32 \[40001, 4\]"):
        adam_step(*given, *SETTINGS)
