"""The reported numbers of training steps, which stay on the device until they are shown."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

__all__ = ["History", "StepNumbers"]


class StepNumbers(Mapping[str, float]):
    """Named numbers of one step. Reading the first of them copies all to the host, which waits for a GPU.

    Args:
        names: K names.
        values: [K].
    """

    def __init__(self, names: Sequence[str], values: Tensor) -> None:
        self.names, self.values_on_device = tuple(names), values
        self._read: dict[str, float] | None = None

    @classmethod
    def of(cls, numbers: Mapping[str, Tensor]) -> StepNumbers:
        """Return named numbers, each [], which are put together without waiting."""
        return cls(tuple(numbers), torch.stack([value.detach().float() for value in numbers.values()]))

    def _all(self) -> dict[str, float]:
        if self._read is None:
            self._read = dict(zip(self.names, self.values_on_device.tolist(), strict=True))
        return self._read

    def __getitem__(self, name: str) -> float:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


class History:
    """The numbers of the last steps.

    Args:
        length: number of steps that are kept.
    """

    def __init__(self, length: int) -> None:
        self._steps: deque[tuple[int, StepNumbers]] = deque(maxlen=length)

    def add(self, step: int, numbers: StepNumbers) -> None:
        """Keep the numbers of a step; those of the same and of later steps, which were not taken, are dropped."""
        self.forget_from(step)
        self._steps.append((step, numbers))

    def forget_from(self, step: int) -> None:
        """Drop the numbers of a step and of later ones."""
        while self._steps and self._steps[-1][0] >= step:
            self._steps.pop()

    def since(self, step: int) -> list[tuple[int, StepNumbers]]:
        """Return the kept steps from `step` on, with their numbers."""
        return [(one, numbers) for one, numbers in self._steps if one >= step]

    def means(self) -> dict[str, float]:
        """Return the mean of each number over the kept steps that have it; waits for a GPU once."""
        names = list(dict.fromkeys(name for _, numbers in self._steps for name in numbers))
        read = torch.cat([numbers.values_on_device for _, numbers in self._steps]).tolist() if names else []
        found: dict[str, list[float]] = {name: [] for name in names}
        for name, value in zip((name for _, numbers in self._steps for name in numbers), read, strict=True):
            found[name].append(value)
        return {name: sum(values) / len(values) for name, values in found.items()}
