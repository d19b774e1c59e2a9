"""A step of Adam for all parameters of a model on a GPU, by the kernels of csrc/cuda/optimizer.cu."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import Structure, c_double, c_float, c_int, c_longlong, c_void_p

import torch
from torch import Tensor

from snarfcli.native.cuda_driver import KernelLauncher, gpu

__all__ = ["adam_step", "run_adam_step"]

_ARRAYS = 50  # of one launch
_THREADS = 256
_PART_NUMBERS = 1024
_CHECK_BLOCKS = 512  # maximum per launch; every block of the second kernel reads the flags of all of them


class _Array(Structure):
    """`AdamArray` of csrc/cuda/optimizer.cu."""

    _fields_ = [
        *((name, c_void_p) for name in ("values", "gradient", "first", "second", "average")),
        ("rows", c_longlong),
        ("rate", c_double),
        *((name, c_int) for name in ("columns", "skips_untouched", "end_part")),
    ]


class _Task(Structure):
    """`AdamTask` of csrc/include/snarf/adam.h, which the kernels alone read and write."""

    _fields_ = [
        *((name, c_float) for name in ("first_decay", "second_decay", "epsilon")),
        *((name, c_float) for name in ("rate_correction", "root_correction", "average_decay")),
    ]


class _Launch(Structure):
    """`AdamLaunch` of csrc/cuda/optimizer.cu."""

    _fields_ = [
        ("arrays", _Array * _ARRAYS),
        *((name, c_void_p) for name in ("learning_rate", "step", "skip", "task", "flags", "left_out")),
        ("average_decay", c_double),
        *((name, c_float) for name in ("first_decay", "second_decay", "epsilon")),
        *((name, c_int) for name in ("count", "first_flag", "flag_count")),
    ]


def adam_step(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    averages: Sequence[Tensor],
    rates: Sequence[float],
    skips_untouched: Sequence[bool],
    learning_rate: Tensor,
    step: Tensor,
    skip: Tensor,
    decays: tuple[float, float],
    epsilon: float,
    average_decay: float,
) -> Tensor:
    """Take one step of Adam in place; see `training.adam.adam_step_on_device` for arguments and result.

    All arrays are contiguous float32 on the same GPU. Runs on PyTorch's current stream and never waits for the device. A CUDA
    graph keeps the addresses of all arrays (run a step before the capture, to load the kernels).

    Raises:
        RuntimeError: the kernels cannot be compiled, or the device reports an error.
    """
    with torch.cuda.device(skip.device):
        arrays = (values, gradients, first, second, averages, rates, skips_untouched)
        return run_adam_step(gpu(learning_rate), *arrays, learning_rate, step, skip, decays, epsilon, average_decay)


def run_adam_step(
    launcher: KernelLauncher,
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    averages: Sequence[Tensor],
    rates: Sequence[float],
    skips_untouched: Sequence[bool],
    learning_rate: Tensor,
    step: Tensor,
    skip: Tensor,
    decays: tuple[float, float],
    epsilon: float,
    average_decay: float,
) -> Tensor:
    """Launch the kernels of a step; arguments and result as in `adam_step`."""
    arrays = [
        _array(tensors, rate, skips)
        for *tensors, rate, skips in zip(values, gradients, first, second, averages, rates, skips_untouched, strict=True)
        if tensors[0].numel()
    ]
    launches = [_launch(arrays[start : start + _ARRAYS]) for start in range(0, max(len(arrays), 1), _ARRAYS)]
    checks = [min(_parts(launch), _CHECK_BLOCKS) for launch in launches]
    scratch = torch.empty(ctypes.sizeof(_Task) + sum(checks), dtype=torch.uint8, device=skip.device)
    left_out = torch.empty_like(skip)
    for index, launch in enumerate(launches):
        launch.learning_rate, launch.step, launch.skip = learning_rate.data_ptr(), step.data_ptr(), skip.data_ptr()
        launch.task, launch.flags = scratch.data_ptr(), scratch.data_ptr() + ctypes.sizeof(_Task)
        launch.left_out = left_out.data_ptr()
        launch.first_decay, launch.second_decay = decays
        launch.epsilon, launch.average_decay = epsilon, average_decay
        launch.first_flag, launch.flag_count = sum(checks[:index]), sum(checks)
    threads = launcher.threads(_THREADS)
    for launch, blocks in zip(launches, checks, strict=True):
        launcher.launch("optimizer", "check_gradients", (blocks, 1), threads, launch)
    for launch in launches:
        launcher.launch("optimizer", "update_parameters", (_parts(launch), 1), threads, launch)
    return left_out


def _array(tensors: Sequence[Tensor], rate: float, skips_untouched: bool) -> _Array:
    """Return one parameter of at least one number; without rows to skip it counts as a column."""
    rows = len(tensors[0]) if skips_untouched else tensors[0].numel()
    columns = tensors[0].numel() // rows
    return _Array(*(tensor.data_ptr() for tensor in tensors), rows, rate, columns, skips_untouched)


def _launch(arrays: Sequence[_Array]) -> _Launch:
    launch, parts = _Launch(count=len(arrays)), 0
    for index, array in enumerate(arrays):
        parts += -(-array.rows // max(_PART_NUMBERS // array.columns, 1))
        array.end_part = parts
        launch.arrays[index] = array
    return launch


def _parts(launch: _Launch) -> int:
    """Return the number of parts of a launch; at least one block has to run."""
    return launch.arrays[launch.count - 1].end_part if launch.count else 1
