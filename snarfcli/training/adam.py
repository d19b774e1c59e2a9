"""A step of Adam with a moving average of the parameters: the readable version, and an operator that waits for no device."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.native import cuda_optimizer
from snarfcli.native.backend import choose_backend

__all__ = ["adam_step_on_device", "adam_step_on_device_reference", "adam_step_reference"]


def adam_step_reference(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    averages: Sequence[Tensor],
    rates: Sequence[float],
    skips_untouched: Sequence[bool],
    step: int,
    decays: tuple[float, float],
    epsilon: float,
    average_decay: float,
) -> float:
    """Take one step of Adam and of the average of the parameters in place: the readable version, for every device.

    Args:
        values: the parameters.
        gradients: of the loss by them, of the same shapes, as are the following.
        first, second: moments of the gradients.
        averages: of the parameters.
        rates: learning rate of each.
        skips_untouched: whether rows whose gradient is all zero keep their values and moments.
        step: 1 for the first.
        decays: of the two moments.
        epsilon: added to the root of the second moment.
        average_decay: of the averages.

    Returns:
        The sum of the magnitudes of all gradients. If it is not finite, nothing has changed.
    """
    magnitude = float(sum(gradient.abs().sum(dtype=torch.float64) for gradient in gradients))
    if not math.isfinite(magnitude):
        return magnitude
    corrections = [1 - decay**step for decay in decays]
    for value, gradient, mean, square, average, rate, skips in zip(
        values, gradients, first, second, averages, rates, skips_untouched, strict=True
    ):
        corrected = (rate / corrections[0], corrections[1])
        updated = _updated(value, gradient, mean, square, *corrected, decays, epsilon, skips)
        for old, new in zip((value, mean, square), updated, strict=True):
            old.copy_(new)
        average.lerp_(value, 1 - average_decay)
    return magnitude


@torch.library.custom_op("snarf::adam_step", mutates_args=("values", "first", "second", "averages"))
def adam_step_on_device(
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
    decays: Sequence[float],
    epsilon: float,
    average_decay: float,
) -> Tensor:
    """Take one step in place, as `adam_step_reference` does, with its numbers on the device of the parameters.

    Never waits for the device, and can be captured in a CUDA graph. By two kernels for float32 on a GPU, else by PyTorch.

    Args:
        rates: multiples of the learning rate.
        learning_rate: [], float32.
        step: [], int64, 0 for the first.
        skip: [], bool, whether to leave the step out.
        average_decay: of the averages, at most; less in the first steps.

    Returns:
        [], bool: whether the step was left out, by `skip` or for a gradient that is not finite. Then nothing has changed.
    """
    settings = (learning_rate, step, skip, decays, epsilon, average_decay)
    return adam_step_on_device_reference(values, gradients, first, second, averages, rates, skips_untouched, *settings)


def adam_step_on_device_reference(
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
    decays: Sequence[float],
    epsilon: float,
    average_decay: float,
) -> Tensor:
    """Do what `adam_step_on_device` does, by PyTorch's operators."""
    left_out = skip.clone()
    for gradient in gradients:
        left_out |= ~gradient.abs().sum(dtype=torch.float64).isfinite()
    exact = step.double()
    corrections = [1 - decay ** (exact + 1) for decay in decays]
    follows = 1 - ((2 + exact) / (11 + exact)).clamp(max=average_decay)
    for value, gradient, mean, square, average, rate, skips in zip(
        values, gradients, first, second, averages, rates, skips_untouched, strict=True
    ):
        corrected = ((learning_rate.double() * rate / corrections[0]).to(value.dtype), corrections[1].to(value.dtype))
        updated = _updated(value, gradient, mean, square, *corrected, decays, epsilon, skips)
        followed = average.lerp(updated[0], follows.to(value.dtype))
        for old, new in zip((value, mean, square, average), (*updated, followed), strict=True):
            old.copy_(torch.where(left_out, old, new))
    return left_out


@adam_step_on_device.register_kernel("cuda")
def _(values, gradients, first, second, averages, rates, skips_untouched, learning_rate, *settings):
    arrays = (values, gradients, first, second, averages)
    takes = all(array.dtype == torch.float32 and array.is_contiguous() for kind in arrays for array in kind)
    is_native = takes and choose_backend("auto", learning_rate.device) == "native"
    run = cuda_optimizer.adam_step if is_native else adam_step_on_device_reference
    return run(*arrays, rates, skips_untouched, learning_rate, *settings)


@adam_step_on_device.register_fake
def _(values, gradients, first, second, averages, rates, skips_untouched, learning_rate, step, skip, *settings):
    return torch.empty_like(skip)


def _updated(
    value: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rate: float | Tensor,
    correction: float | Tensor,
    decays: Sequence[float],
    epsilon: float,
    skips_untouched: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the next value and moments of a parameter.

    Args:
        rate: learning rate, corrected for the first moments' start at zero.
        correction: of the second moments.
    """
    new_mean = mean.lerp(gradient, 1 - decays[0])
    new_square = square.lerp(gradient * gradient, 1 - decays[1])
    new_value = value - rate * new_mean / ((new_square / correction).sqrt() + epsilon)
    if not skips_untouched:
        return new_value, new_mean, new_square
    touched = gradient.unsqueeze(-1).flatten(1).ne(0).any(1).reshape(-1, *[1] * (gradient.ndim - 1))
    return (
        torch.where(touched, new_value, value),
        torch.where(touched, new_mean, mean),
        torch.where(touched, new_square, square),
    )
