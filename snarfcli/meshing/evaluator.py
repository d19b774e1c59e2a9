"""Values of a field, asked for in chunks, without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from snarfcli.errors import UserError

__all__ = ["Evaluator"]

_LARGEST = torch.finfo(torch.float32).max / 4  # differences of two values stay finite


class Evaluator:
    """Evaluates a field in chunks, and counts points and calls.

    NaN is noticed in `read`, when the host waits for the device anyway.

    Args:
        field: points [N, 3] float32 -> values [N], on any device.
        level: value at the surface.
        chunk: maximum number of points per call of the field.
        device: of the points.
    """

    def __init__(self, field: Callable[[Tensor], Tensor], level: float, chunk: int, device: torch.device) -> None:
        self.field = field
        self.level = level
        self.chunk = chunk
        self.device = device
        self.points = 0
        self.calls = 0
        self._nans = torch.zeros((), dtype=torch.long, device=device)

    @torch.no_grad()
    def at(self, positions: Tensor) -> Tensor:
        """Return field minus level, [N] float32 and finite, at positions [N, 3] float32.

        Raises:
            ValueError: the field returns another shape.
        """
        parts = []
        for points in positions.split(self.chunk):
            values = self.field(points)
            if values.shape != points.shape[:1]:
                raise ValueError(f"field: wanted shape [{len(points)}], one value per point, got {list(values.shape)}")
            values = values.detach().to(self.device, torch.float32) - self.level
            self._nans += values.isnan().sum()
            parts.append(values.clamp(-_LARGEST, _LARGEST))
            self.points += len(points)
            self.calls += 1
        return torch.cat(parts)

    def read(self, *facts: Tensor) -> list[list[bool]]:
        """Return boolean tensors as lists of their entries, with one wait for the device.

        Raises:
            UserError: the field has returned NaN.
        """
        numbers = torch.cat([self._nans[None], *(fact.reshape(-1).long() for fact in facts)]).tolist()
        if numbers[0]:
            raise UserError(f"field: wanted numbers, got NaN at {numbers[0]} of {self.points} points")
        lists, first = [], 1
        for fact in facts:
            lists.append([bool(number) for number in numbers[first : first + fact.numel()]])
            first += fact.numel()
        return lists
