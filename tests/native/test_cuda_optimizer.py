"""The CUDA kernels of a step of Adam, run through the same launches on a GPU, where there is one, and by an emulation."""

from __future__ import annotations

import ctypes
import itertools

import pytest
import torch
from adam_arrays import DECAYS, EPSILON, AdamArrays, adam_arrays, are_equal, new_gradients
from cuda_emulation import EmulatedGpu, build_emulation, require_compiler

from snarfcli.native import cuda_compile, cuda_optimizer
from snarfcli.native.cpu_optimizer import adam_step
from snarfcli.native.cuda_optimizer import run_adam_step
from snarfcli.training.adam import adam_step_on_device, adam_step_reference

HAS_GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not HAS_GPU, reason="needs a CUDA device")

RATE = 0.01171875  # exact in float32, also times 3
PART = cuda_optimizer._PART_NUMBERS
# Sizes around those of a block and of a part, with and without rows that may be skipped.
PLAIN = [(), (0,), (1,), (255,), (256,), (257,), (PART - 1,), (PART,), (PART + 1,), (17, 5), (3, 2, 4), (2, 2500)]
ROWS = [(1, 1), (0, 4), (4001, 2), (511, 4), (512, 4), (513, 4), (700, 24), (42, 24), (43, 24), (2, 1500), (1025,), (301, 2, 3)]
SHAPES = PLAIN + ROWS
RATES = [3.0 if index % 3 else 1.0 for index in range(len(SHAPES))]
SKIPS = [False] * len(PLAIN) + [True] * len(ROWS)


class Runner:
    """Takes steps by the kernels, on the emulation or on a GPU, with arrays on the CPU."""

    def __init__(self, device: str, block: int = 1) -> None:
        self.device, self.block = device, block

    def __call__(self, arrays: AdamArrays, step: int, rates=RATES, skips=SKIPS, skip=False, average_decay=0.5) -> bool:
        numbers = [torch.tensor(RATE), torch.tensor(step), torch.tensor(skip)]
        settings = (DECAYS, EPSILON, average_decay)
        if self.device == "emulated":
            left_out = run_adam_step(EmulatedGpu(torch.float32, self.block), *arrays, rates, skips, *numbers, *settings)
        else:
            moved = [[array.cuda() for array in kind] for kind in arrays]
            left_out = adam_step_on_device(*moved, rates, skips, *(number.cuda() for number in numbers), *settings)
            for mine, theirs in zip(itertools.chain(*arrays), itertools.chain(*moved), strict=True):
                mine.copy_(theirs)
        assert left_out.dtype == torch.bool
        assert left_out.shape == ()
        return bool(left_out)


@pytest.fixture(params=["emulated", "cuda"] if HAS_GPU else ["emulated"])
def runner(request):
    if request.param == "emulated":
        require_compiler()
    return Runner(request.param)


def on_the_host(run, arrays: AdamArrays, step: int, average_decay: float = 0.5) -> None:
    decay = min(average_decay, (2 + step) / (11 + step))
    run(*arrays, [RATE * rate for rate in RATES], SKIPS, step + 1, DECAYS, EPSILON, decay)


# ---------------------------------------------------------------- arguments
def test_structures_and_constants_match_the_kernels():
    require_compiler()
    library = build_emulation(torch.float32)
    assert library.optimizer_bytes() == ctypes.sizeof(cuda_optimizer._Launch) < 4096  # the limit before CUDA 12.1
    assert library.optimizer_task_bytes() == ctypes.sizeof(cuda_optimizer._Task)
    source = (cuda_compile.cuda_sources() / "cuda" / "optimizer.cu").read_text()
    constants = {"kAdamArrays": "_ARRAYS", "kAdamThreads": "_THREADS", "kPartNumbers": "_PART_NUMBERS"}
    for theirs, mine in constants.items():
        assert f"{theirs} = {getattr(cuda_optimizer, mine)};" in source


# ---------------------------------------------------------------- results
@pytest.mark.parametrize("first_step", [0, 1000])
def test_several_steps_equal_those_of_the_cpu(runner, first_step):
    mine, theirs = adam_arrays(SHAPES, 0), adam_arrays(SHAPES, 0)
    for step in range(first_step, first_step + 4):
        assert not runner(mine, step)
        on_the_host(adam_step, theirs, step)
        for name, found, wanted in zip(("value", "gradient", "first", "second", "average"), mine, theirs, strict=True):
            for a, b in zip(found, wanted, strict=True):
                # One formula (adam.h), compiled with other instructions: a*b+c may be rounded once or twice. The bits are the
                # same as those of the CPU library without FMA. Measured worst 3e-7 in values, 1e-6 in moments.
                torch.testing.assert_close(a, b, rtol=3e-6, atol=3e-6, msg=lambda text, n=name: f"{n}: {text}")
        for arrays in (mine, theirs):
            new_gradients(arrays, step)


def test_a_step_equals_the_reference(runner):
    mine, wanted = adam_arrays(SHAPES, 1), adam_arrays(SHAPES, 1, torch.float64)
    runner(mine, 6, average_decay=0.9)
    on_the_host(adam_step_reference, wanted, 6, average_decay=0.9)
    for a, b in zip(itertools.chain(*mine), itertools.chain(*wanted), strict=True):
        torch.testing.assert_close(a, b.float(), rtol=2e-5, atol=2e-6)  # the kernels' decays are float32


def test_rows_without_a_gradient_keep_values_and_moments(runner):
    mine, before = adam_arrays(SHAPES, 2), adam_arrays(SHAPES, 2)
    runner(mine, 3)
    grids = [index for index, skips in enumerate(SKIPS) if skips and mine[1][index].numel() > 1]
    kept = 0
    for index in grids:
        touched = before[1][index].reshape(len(before[1][index]), -1).ne(0).any(1)
        kept += int((~touched).sum())
        for kind in (0, 2, 3):
            assert torch.equal(mine[kind][index][~touched], before[kind][index][~touched])
            assert (mine[kind][index][touched] != before[kind][index][touched]).float().mean() > 0.99
        changed = mine[4][index] != before[4][index]
        assert changed.float().mean() > 0.99  # the average follows all the same
    assert kept > 3000


def test_the_average_follows_quickly_at_first(runner):
    for step, decay in ((0, 2 / 11), (10, 12 / 21), (5000, 0.99)):
        arrays = adam_arrays(SHAPES, 3)
        before = [average.clone() for average in arrays[4]]
        runner(arrays, step, average_decay=0.99)
        for value, old, new in zip(arrays[0], before, arrays[4], strict=True):
            torch.testing.assert_close(new, decay * old + (1 - decay) * value)


@pytest.mark.parametrize("block", [2, 7, 64])
def test_the_number_of_threads_does_not_matter(block):
    require_compiler()
    shapes = [(), (PART + 1,), (513, 4), (43, 24)]
    alone, together = adam_arrays(shapes, 4), adam_arrays(shapes, 4)
    rates, skips = [1.0, 2.0, 3.0, 1.0], [False, False, True, True]
    assert not Runner("emulated")(alone, 2, rates, skips)
    assert not Runner("emulated", block)(together, 2, rates, skips)
    assert are_equal(alone, together)
    together[1][1][-1] = torch.nan
    assert Runner("emulated", block)(together, 3, rates, skips)


def test_blocks_of_the_check_go_through_many_parts(runner, monkeypatch):
    monkeypatch.setattr(cuda_optimizer, "_CHECK_BLOCKS", 3)
    arrays, before = adam_arrays(SHAPES, 5), adam_arrays(SHAPES, 5)
    for index in [index for index, value in enumerate(arrays[0]) if value.numel()]:
        for place in {0, arrays[1][index].numel() // 2, arrays[1][index].numel() - 1}:
            wrong = [[array.clone() for array in kind] for kind in before]
            wrong[1][index].view(-1)[place] = torch.nan
            assert runner(wrong, 1), f"array {index}, number {place}"
    assert not runner(arrays, 1)


# ---------------------------------------------------------------- steps that are left out
@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("index", [0, 8, 14])
def test_a_gradient_that_is_not_finite_changes_nothing(runner, wrong, index):
    arrays, before = adam_arrays(SHAPES, 6), adam_arrays(SHAPES, 6)
    for made in (arrays, before):
        made[1][index].view(-1)[-1] = wrong
    assert runner(arrays, 1)
    for kind in (0, 2, 3, 4):
        assert are_equal([arrays[kind]], [before[kind]])
    new_gradients(arrays, 7)
    assert not runner(arrays, 1)  # the same step, tried again
    assert not are_equal([arrays[0]], [before[0]])


def test_the_largest_gradient_is_still_finite(runner):
    arrays = adam_arrays(SHAPES, 8)
    arrays[1][5][0] = torch.finfo(torch.float32).max
    assert not runner(arrays, 1)


def test_a_step_is_skipped_on_demand(runner):
    arrays, before = adam_arrays(SHAPES, 9), adam_arrays(SHAPES, 9)
    assert runner(arrays, 4, skip=True)
    assert are_equal(arrays, before)


def test_without_a_single_number_there_is_nothing_to_do(runner):
    for shapes in ([], [(0, 4), (0,)]):
        arrays = adam_arrays(shapes, 10)
        if shapes or runner.device == "emulated":
            for skip in (False, True):
                assert runner(arrays, 0, [1.0] * len(shapes), [False] * len(shapes), skip=skip) is skip


# ---------------------------------------------------------------- launches
@pytest.mark.parametrize("count", [1, 49, 50, 51, 120])
def test_two_launches_for_up_to_fifty_arrays(count):
    require_compiler()
    shapes = [(index % 5 + 1, 3) for index in range(count)]
    arrays, before, theirs = (adam_arrays(shapes, 11) for _ in range(3))
    emulated = EmulatedGpu(torch.float32)
    rates, skips = [1.0] * count, [False] * count
    numbers = (torch.tensor(RATE), torch.tensor(2), torch.tensor(False))
    assert not run_adam_step(emulated, *arrays, rates, skips, *numbers, DECAYS, EPSILON, 0.0)
    launches = -(-count // 50)
    assert emulated.launches == ["check_gradients"] * launches + ["update_parameters"] * launches
    adam_step(*theirs, [RATE] * count, skips, 3, DECAYS, EPSILON, 0.0)
    for a, b in zip(itertools.chain(*arrays), itertools.chain(*theirs), strict=True):
        torch.testing.assert_close(a, b, rtol=3e-6, atol=3e-6)
    before[1][-1][-1] = torch.inf  # in the last launch; nothing may change in the first
    values = [value.clone() for value in before[0]]
    assert run_adam_step(emulated, *before, rates, skips, *numbers, DECAYS, EPSILON, 0.0)
    assert are_equal([before[0]], [values])


# ---------------------------------------------------------------- on a GPU
@needs_gpu
def test_steps_fit_into_a_cuda_graph():
    mine, theirs = ([[array.cuda() for array in kind] for kind in adam_arrays(SHAPES, 12)] for _ in range(2))
    rate, step, skip = torch.tensor(RATE).cuda(), torch.tensor(0).cuda(), torch.tensor(False).cuda()
    given = (RATES, SKIPS, rate, step, skip, DECAYS, EPSILON, 0.5)
    skip.fill_(True)
    assert adam_step_on_device(*mine, *given)  # loads the kernels
    skip.fill_(False)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        left_out = adam_step_on_device(*mine, *given)
    for count in range(4):
        step.fill_(count)
        skip.fill_(count == 2)
        graph.replay()
        assert bool(left_out) is (count == 2)
        assert bool(adam_step_on_device(*theirs, *given)) is (count == 2)
        for arrays in (mine, theirs):
            new_gradients(arrays, count)
    assert are_equal(mine, theirs)
