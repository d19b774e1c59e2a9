"""Adam with an average while a feature grid grows."""

from __future__ import annotations

import copy

import pytest
import torch
from cuda_emulation import EmulatedGpu, require_compiler
from torch import nn
from toy_training import training_config

from snarfcli.native.cuda_optimizer import run_adam_step
from snarfcli.shape.features import FeatureGrids
from snarfcli.training import optimizer as optimizer_module
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


# ---------------------------------------------------------------- on the device
def emulated_step(*arguments):
    return run_adam_step(EmulatedGpu(torch.float32), *arguments)


@pytest.fixture(params=["operators", "kernels"])
def way(request, monkeypatch):
    """Let `step_on_device` run PyTorch's operators or the emulated kernels."""
    if request.param == "kernels":
        require_compiler()
        monkeypatch.setattr(optimizer_module, "adam_step_on_device", emulated_step)
    return request.param


def on_device(optimizer: AveragedAdam, step: int, skip: bool = False) -> bool:
    return bool(optimizer.step_on_device(torch.tensor(0.01), torch.tensor(step), torch.tensor(skip)))


def state_of(optimizer: AveragedAdam) -> list[torch.Tensor]:
    state = optimizer.state()
    moments = state["optimizer"]
    return [*map(torch.clone, optimizer.parameters), *state["average"], *moments["first"], *moments["second"]]


def test_steps_on_the_device_equal_those_on_the_host(way):
    """Also after growth, new values of rows, and a start from a saved state."""
    models = Model(), Model()
    optimizers = [AveragedAdam(model, training_config(feature_rate=3.0, average_decay=0.9)) for model in models]

    def compare(first: int) -> None:
        for step in range(first, first + 3):
            for model, optimizer in zip(models, optimizers, strict=True):
                optimizer.zero_gradients()
                model.loss().backward()
            optimizers[0].step(float(torch.tensor(0.01)), step)
            assert not on_device(optimizers[1], step)
        for wanted, found in zip(*map(state_of, optimizers), strict=True):
            torch.testing.assert_close(found, wanted, rtol=3e-5, atol=1e-6)  # decays in float32 or float64

    compare(0)
    for model, optimizer in zip(models, optimizers, strict=True):
        torch.manual_seed(1)
        assert model.grids.cover() > 0
        optimizer.follow_growth()
    compare(3)
    for model, optimizer in zip(models, optimizers, strict=True):
        rows = torch.zeros(len(model.grids.table), dtype=torch.bool)
        rows[[1, 4]] = True
        with torch.no_grad():
            model.grids.table[rows] = 0.5
        optimizer.restart(model.grids.table, rows)
    compare(6)
    for optimizer in optimizers:
        optimizer.restore(copy.deepcopy(optimizer.state()))
    compare(9)


def test_parameters_without_a_gradient_stay(way):
    model = Model()
    optimizer = AveragedAdam(model, training_config(average_decay=0.9))
    (model.plain**2).sum().backward()
    table = model.grids.table.detach().clone()
    assert not on_device(optimizer, 0)
    assert torch.equal(model.grids.table, table)
    assert (model.plain != 1).all()


def test_an_update_on_the_device_is_left_out(way):
    model = Model()
    optimizer = AveragedAdam(model, training_config(average_decay=0.9))
    steps(model, optimizer, 2)
    optimizer.zero_gradients()
    model.loss().backward()
    before = state_of(optimizer)
    assert on_device(optimizer, 2, skip=True)
    gradient = model.plain.grad
    assert gradient is not None
    gradient[1] = torch.nan
    assert on_device(optimizer, 2)
    assert all(torch.equal(a, b) for a, b in zip(before, state_of(optimizer), strict=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_parameters_of_any_layout_and_type(dtype):
    """Such as matrices that a caller gave in transposed."""
    model = nn.Linear(3, 5).to(dtype)
    model.weight = nn.Parameter(model.weight.detach().t().contiguous().t())
    twin = copy.deepcopy(model)
    optimizers = [AveragedAdam(one, training_config()) for one in (model, twin)]
    for step in range(3):
        for one in (model, twin):
            one.zero_grad()
            one(torch.ones(2, 3, dtype=dtype)).square().sum().backward()
        optimizers[0].step(float(torch.tensor(0.01)), step)
        assert not on_device(optimizers[1], step)
    for a, b in zip(*map(state_of, optimizers), strict=True):
        torch.testing.assert_close(a, b, rtol=3e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"learning_rate": torch.tensor(0.01).double()}, r"learning_rate: wanted \[\] torch.float32 on cpu, got \[\] .*64 on"),
        ({"step": torch.zeros(1, dtype=torch.long)}, r"step: wanted \[\] torch.int64 on cpu, got \[1\] torch.int64 on cpu"),
        ({"skip": torch.tensor(0)}, r"skip: wanted \[\] torch.bool on cpu, got \[\] torch.int64"),
        ({"step": torch.zeros((), dtype=torch.long, device="meta")}, r"step: wanted \[\] torch.int64 on cpu, got .* on meta"),
    ],
)
def test_numbers_of_another_kind_are_refused(changed, message):
    given = {"learning_rate": torch.tensor(0.01), "step": torch.tensor(0), "skip": torch.tensor(False)} | changed
    optimizer = AveragedAdam(Model(), training_config())
    with pytest.raises(ValueError, match=message):
        optimizer.step_on_device(**given)
