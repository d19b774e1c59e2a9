"""Adam over the parameters of a system, with a moving average of them, while feature grids grow."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from snarfcli.models.file_tensors import read_tensor
from snarfcli.native.backend import choose_backend
from snarfcli.native.cpu_optimizer import adam_step
from snarfcli.training.adam import adam_step_on_device, adam_step_reference
from snarfcli.training.settings import TrainingConfig

__all__ = ["AveragedAdam"]

_DECAYS = (0.9, 0.999)
_EPSILON = 1e-8
_Arrays = tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor], list[Tensor]]
"""Values, gradients, both moments and averages."""


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

    def tensors(self) -> list[Tensor]:
        """Return all that a step changes: parameters, moments and averages."""
        return [*self.parameters, *self._first, *self._second, *self.average]

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
        arrays, rates, skips_untouched = self._used()
        is_native = all(v.device.type == "cpu" and v.dtype == torch.float32 and v.is_contiguous() for v in arrays[0])
        run = adam_step if is_native and choose_backend("auto") == "native" else adam_step_reference
        average_decay = min(self._config.average_decay, (2 + step) / (11 + step))
        rates = [learning_rate * rate for rate in rates]
        return run(*arrays, rates, skips_untouched, step + 1, _DECAYS, _EPSILON, average_decay)

    @torch.no_grad()
    def step_on_device(self, learning_rate: Tensor, step: Tensor, skip: Tensor) -> Tensor:
        """Update as `step` does, without waiting for the device of the parameters, which holds the arguments too.

        Can be captured in a CUDA graph. The graph keeps the addresses of parameters, gradients, moments and averages: it has to
        be captured anew after `restore`, and after `follow_growth` if the model has replaced parameters.

        Args:
            learning_rate: [], float32.
            step: [], int64, counts from 0.
            skip: [], bool, whether to leave the update out.

        Returns:
            [], bool: whether the update was left out, by `skip` or for a gradient that is not finite. Then nothing has changed.

        Raises:
            ValueError: an argument has another shape, type or device.
        """
        for name, given, dtype in (
            ("learning_rate", learning_rate, torch.float32),
            ("step", step, torch.int64),
            ("skip", skip, torch.bool),
        ):
            if given.shape or given.dtype != dtype or given.device != skip.device:
                found = f"{[*given.shape]} {given.dtype} on {given.device}"
                raise ValueError(f"{name}: wanted [] {dtype} on {skip.device}, got {found}")
        arrays, rates, skips_untouched = self._used()
        settings = (learning_rate, step, skip, _DECAYS, _EPSILON, self._config.average_decay)
        return adam_step_on_device(*arrays, rates, skips_untouched, *settings)

    def _used(self) -> tuple[_Arrays, list[float], list[bool]]:
        """Return the arrays of the parameters that have a gradient.

        Further their learning rates, as multiples of the common one, and whether rows without a gradient are kept as they are.
        """
        used = [index for index, parameter in enumerate(self.parameters) if parameter.grad is not None]
        values = [self.parameters[index].detach() for index in used]
        gradients = [parameter.grad.contiguous() for parameter in self.parameters if parameter.grad is not None]
        first, second, average = ([kind[index] for index in used] for kind in (self._first, self._second, self.average))
        rates = [self._config.feature_rate if self._are_features[index] else 1.0 for index in used]
        return (values, gradients, first, second, average), rates, [self._are_nodes[index] for index in used]

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
