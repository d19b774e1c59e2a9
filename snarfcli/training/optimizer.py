"""Adam over the parameters of a system, with a moving average of them, while feature grids grow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from snarfcli.models.file_tensors import read_tensor
from snarfcli.native.backend import choose_backend
from snarfcli.native.cpu_optimizer import adam_step
from snarfcli.training.settings import TrainingConfig

__all__ = ["AveragedAdam", "adam_step_reference"]

_DECAYS = (0.9, 0.999)
_EPSILON = 1e-8


class AveragedAdam:
    """Adam with a faster learning rate for feature grids, and an exponential moving average of the parameters.

    Rows at the nodes of a grid (features, logits of skinning weights) that have no gradient in a step keep their values and
    moments in it.

    Args:
        model: the system whose parameters are trained.
        config: learning rates and decay of the average.

    Source: Kingma and Ba, Adam, ICLR 2015, Algorithm 1; rows without a gradient after Mueller et al., SIGGRAPH 2022, Sec. 4.
    """

    def __init__(self, model: nn.Module, config: TrainingConfig) -> None:
        self._model, self._config = model, config
        self.parameters = self._trained()
        self.average = [_copy(parameter.detach()) for parameter in self.parameters]
        self._first = [torch.zeros_like(value) for value in self.average]
        self._second = [torch.zeros_like(value) for value in self.average]
        names = [name for name, parameter in model.named_parameters() if parameter.requires_grad]
        self._are_features = [name.endswith("grids.table") for name in names]
        self._are_nodes = [name.endswith(("grids.table", "field.logits")) for name in names]

    def _trained(self) -> list[nn.Parameter]:
        return [parameter for parameter in self._model.parameters() if parameter.requires_grad]

    def zero_gradients(self) -> None:
        """Forget the gradients of the last step."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, learning_rate: float, step: int) -> float:
        """Update the parameters, and then their average; `step` counts from 0.

        The average follows quickly at first, since the first parameters are far from the final ones.

        Returns:
            The sum of the magnitudes of all gradients. If it is not finite, nothing has changed.
        """
        used = [index for index, parameter in enumerate(self.parameters) if parameter.grad is not None]
        gradients = [self.parameters[index].grad for index in used]
        values = [self.parameters[index].detach() for index in used]
        rates = [learning_rate * (self._config.feature_rate if self._are_features[index] else 1.0) for index in used]
        is_native = all(v.device.type == "cpu" and v.dtype == torch.float32 and v.is_contiguous() for v in values)
        run = adam_step if is_native and choose_backend("auto") == "native" else adam_step_reference
        return run(
            values,
            [gradient.contiguous() for gradient in gradients if gradient is not None],
            [self._first[index] for index in used],
            [self._second[index] for index in used],
            [self.average[index] for index in used],
            rates,
            [self._are_nodes[index] for index in used],
            step + 1,
            _DECAYS,
            _EPSILON,
            min(self._config.average_decay, (2 + step) / (11 + step)),
        )

    @torch.no_grad()
    def follow_growth(self) -> None:
        """Take over parameters that the model replaced by longer ones: moments and average of the new rows start fresh."""
        grown = self._trained()
        for index, (old, new) in enumerate(zip(self.parameters, grown, strict=True)):
            if new is old:
                continue
            added = new.detach()[len(old) :]
            self.average[index] = torch.cat([self.average[index], added])
            for moments in (self._first, self._second):
                moments[index] = torch.cat([moments[index], torch.zeros_like(added)])
        self.parameters = grown

    @torch.no_grad()
    def restart(self, parameter: nn.Parameter, rows: Tensor) -> None:
        """Forget what was known about some rows, bool [R], of a parameter that have new values."""
        for index, mine in enumerate(self.parameters):
            if mine is parameter:
                self.average[index][rows] = parameter.detach()[rows]
                self._first[index][rows] = 0
                self._second[index][rows] = 0

    def state(self) -> dict[str, Any]:
        """Return what the coming steps depend on, besides the parameters."""
        moments = {"first": self._first, "second": self._second}
        return {
            "average": [value.cpu().clone() for value in self.average],
            "optimizer": {name: [value.cpu().clone() for value in values] for name, values in moments.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, for a model that has its parameters already.

        Raises:
            KeyError, RuntimeError, TypeError, ValueError: the state does not fit the model.
        """
        self.parameters = self._trained()
        moments = state["optimizer"]
        given = {"average": state["average"], "first": moments["first"], "second": moments["second"]}
        self.average, self._first, self._second = (
            [self._like(*pair, name) for pair in zip(values, self.parameters, strict=True)] for name, values in given.items()
        )

    @staticmethod
    def _like(value: Any, parameter: Tensor, name: str) -> Tensor:
        return _copy(read_tensor(value, f"optimizer.{name}", parameter.shape, parameter.dtype).to(parameter.detach()))


def _copy(value: Tensor) -> Tensor:
    return value.clone(memory_format=torch.contiguous_format)


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
        new_mean = mean.lerp(gradient, 1 - decays[0])
        new_square = square.lerp(gradient * gradient, 1 - decays[1])
        change = rate / corrections[0] * new_mean / ((new_square / corrections[1]).sqrt() + epsilon)
        if skips:
            touched = gradient.flatten(1).ne(0).any(1).reshape(-1, *[1] * (gradient.ndim - 1))
            new_mean, new_square = torch.where(touched, new_mean, mean), torch.where(touched, new_square, square)
            change = change * touched
        mean.copy_(new_mean)
        square.copy_(new_square)
        value.sub_(change)
        average.lerp_(value, 1 - average_decay)
    return magnitude
