"""Adam over the parameters of a system, with a moving average of them, while feature grids grow."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from snarfcli.training.settings import TrainingConfig

__all__ = ["AveragedAdam"]


class AveragedAdam:
    """Adam with a faster learning rate for feature grids, and an exponential moving average of the parameters.

    Args:
        model: the system whose parameters are trained.
        config: learning rates and decay of the average.
    """

    def __init__(self, model: nn.Module, config: TrainingConfig) -> None:
        self._model, self._config = model, config
        self._start()

    def _start(self) -> None:
        """Start Adam and the average with the parameters that the model has now."""
        model, config = self._model, self._config
        self.parameters = self._trained()
        self.average = [parameter.detach().clone() for parameter in self.parameters]
        tables = {id(p) for name, p in model.named_parameters() if name.endswith("grids.table")}
        groups = [
            [parameter for parameter in self.parameters if id(parameter) not in tables],
            [parameter for parameter in self.parameters if id(parameter) in tables],
        ]
        self._adam = torch.optim.Adam([{"params": group} for group in groups if group], lr=config.learning_rate, fused=True)

    def _trained(self) -> list[nn.Parameter]:
        return [parameter for parameter in self._model.parameters() if parameter.requires_grad]

    def zero_gradients(self) -> None:
        """Forget the gradients of the last step."""
        self._adam.zero_grad(set_to_none=True)

    def gradient_norm(self) -> Tensor:
        """Return the sum of the norms of all gradients."""
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        norms = torch._foreach_norm(gradients)  # pyright: ignore[reportPrivateImportUsage]  # no public name
        return torch.stack(norms).sum()

    def step(self, learning_rate: float, step: int) -> None:
        """Update the parameters, and then their average; `step` counts from 0.

        The average follows quickly at first, since the first parameters are far from the final ones.
        """
        for group, factor in zip(self._adam.param_groups, (1.0, self._config.feature_rate), strict=False):
            group["lr"] = learning_rate * factor
        self._adam.step()
        decay = min(self._config.average_decay, (2 + step) / (11 + step))
        with torch.no_grad():
            current = [parameter.detach() for parameter in self.parameters]
            torch._foreach_lerp_(self.average, current, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]  # no public name

    @torch.no_grad()
    def follow_growth(self) -> None:
        """Take over parameters that the model replaced by longer ones: moments and average of the new rows start fresh."""
        grown = self._trained()
        for index, (old, new) in enumerate(zip(self.parameters, grown, strict=True)):
            if new is old:
                continue
            more = len(new) - len(old)
            self.average[index] = torch.cat([self.average[index], new.detach()[len(old) :]])
            moments = self._adam.state.pop(old, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in moments:
                    moments[name] = torch.cat([moments[name], new.new_zeros(more, *new.shape[1:])])
            if moments:
                self._adam.state[new] = moments
            for group in self._adam.param_groups:
                group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        self.parameters = grown

    def state(self) -> dict[str, Any]:
        """Return what the coming steps depend on, besides the parameters."""
        return {"average": [value.cpu().clone() for value in self.average], "optimizer": self._adam.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, for a model that has its parameters already.

        Raises:
            KeyError, RuntimeError, TypeError, ValueError: the state does not fit the model.
        """
        self._start()
        self._adam.load_state_dict(state["optimizer"])
        for mine, saved in zip(self.average, state["average"], strict=True):
            mine.copy_(saved)
