"""A step of Adam: the readable version, the CPU library's, and the operator that never waits for a device."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from adam_arrays import DECAYS, EPSILON, AdamArrays, adam_arrays, are_equal, new_gradients
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from snarfcli.native.cpu_optimizer import adam_step
from snarfcli.training.adam import adam_step_on_device, adam_step_on_device_reference, adam_step_reference

SHAPES = [(), (3,), (17, 5), (40_001, 4), (0, 4)]
SKIPS = [False, False, False, True, True]
SETTINGS = ([1e-2, 1e-2, 3e-2, 1e-2, 1e-2], SKIPS, 7, DECAYS, EPSILON, 0.9)


def made_up(seed: int, dtype: torch.dtype = torch.float32) -> AdamArrays:
    return adam_arrays(SHAPES, seed, dtype)


def native_step(given: AdamArrays, threads: int) -> float:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return adam_step(*given, *SETTINGS)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_native_step_equals_the_reference(threads):
    native, wanted = made_up(0), made_up(0, torch.float64)
    total = native_step(native, threads)
    assert total == pytest.approx(adam_step_reference(*wanted, *SETTINGS), rel=1e-6)
    for mine, theirs in zip(itertools.chain(*native), itertools.chain(*wanted), strict=True):
        torch.testing.assert_close(mine, theirs.float(), rtol=2e-5, atol=2e-6)
    untouched = (native[1][3] == 0).all(1)
    assert 0.8 < untouched.float().mean() < 0.95
    start = made_up(0)
    for kind in (0, 2, 3):
        assert torch.equal(native[kind][3][untouched], start[kind][3][untouched])
    assert not torch.equal(native[4][3][untouched], start[4][3][untouched])  # the average follows all the same


def test_bits_do_not_depend_on_the_number_of_threads():
    results = []
    for threads in (1, 2, 3):
        given = made_up(1)
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
        adam_step_reference([value], [gradient], *[[s] for s in state], [0.02], [False], step, DECAYS, EPSILON, 0.5)
    torch.testing.assert_close(value, theirs.detach())


@pytest.mark.parametrize("run", [adam_step_reference, adam_step])
@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_changes_nothing(run, wrong):
    given, before = made_up(2), made_up(2)
    given[1][3][-1, -1] = wrong
    assert not math.isfinite(run(*given, *SETTINGS))
    for kind in (0, 2, 3, 4):
        assert all(torch.equal(a, b) for a, b in zip(given[kind], before[kind], strict=True))


def test_arrays_that_do_not_fit_are_refused():
    given = made_up(0)
    given[2][3] = given[2][3][:-1]
    with pytest.raises(ValueError, match=r"parameter 3: wanted contiguous float32 \[40001, 4\]"):
        adam_step(*given, *SETTINGS)


# ---------------------------------------------------------------- on the device
RATES = [1.0, 1.0, 3.0, 1.0, 2.5]


def on_device(given: AdamArrays, step: int, skip: bool = False, run=adam_step_on_device) -> bool:
    numbers = (torch.tensor(0.01171875), torch.tensor(step), torch.tensor(skip))
    return bool(run(*given, RATES, SKIPS, *numbers, DECAYS, EPSILON, 0.5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_steps_on_the_device_have_the_bits_of_the_reference(dtype):
    mine, theirs = made_up(3, dtype), made_up(3, dtype)
    for step in (0, 1, 2, 40_000):
        assert not on_device(mine, step)
        rates = [0.01171875 * rate for rate in RATES]
        adam_step_reference(*theirs, rates, SKIPS, step + 1, DECAYS, EPSILON, min(0.5, (2 + step) / (11 + step)))
        assert are_equal(mine, theirs)
        for arrays in (mine, theirs):
            new_gradients(arrays, step)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, None])
def test_a_step_on_the_device_that_is_left_out_changes_nothing(wrong):
    given, before = made_up(4), made_up(4)
    for arrays in (given, before):
        if wrong is not None:
            arrays[1][2][-1, -1] = wrong
    assert on_device(given, 2, skip=wrong is None)
    for kind in (0, 2, 3, 4):
        assert are_equal([given[kind]], [before[kind]])
    new_gradients(given, 0)
    assert not on_device(given, 2)


@pytest.mark.parametrize("skip", [False, True])
def test_without_a_gradient_only_the_wish_to_skip_counts(skip):
    numbers = (torch.tensor(0.01), torch.tensor(3), torch.tensor(skip))
    assert bool(adam_step_on_device([], [], [], [], [], [], [], *numbers, DECAYS, EPSILON, 0.5)) is skip


class NoHost(TorchDispatchMode):
    """Fails where a number would travel between a device and the host."""

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        assert function not in {torch.ops.aten._local_scalar_dense.default, torch.ops.aten.nonzero.default}
        assert function not in {torch.ops.aten.lift_fresh.default, torch.ops.aten.masked_select.default}
        return function(*arguments, **(keywords or {}))


def test_a_step_on_the_device_reads_and_uploads_no_number():
    given = made_up(5)
    numbers = (torch.tensor(0.01), torch.tensor(3), torch.tensor(False))
    with NoHost():
        left_out = adam_step_on_device_reference(*given, RATES, SKIPS, *numbers, DECAYS, EPSILON, 0.5)
        with pytest.raises(AssertionError):
            bool(left_out)
        with pytest.raises(AssertionError):
            torch.tensor(0.0)


def test_the_operator_is_one():
    small = adam_arrays([(2,), (5, 3)], 6)
    numbers = (torch.tensor(0.01), torch.tensor(3), torch.tensor(False))
    torch.library.opcheck(adam_step_on_device, (*small, [1.0, 3.0], [False, True], *numbers, DECAYS, EPSILON, 0.5))
