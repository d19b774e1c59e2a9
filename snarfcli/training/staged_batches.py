"""Fresh points for static steps: batches that the processor makes, copied to the same place on the device in every step."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import torch
from torch import Tensor

from snarfcli.samples.store import SampleStore
from snarfcli.training.batches import Batch, FreshBatches
from snarfcli.training.settings import TrainingConfig

__all__ = ["StagedBatches"]

_SLOTS = 3  # batches whose copy may be under way
_TENSORS = tuple(field.name for field in fields(Batch) if field.name != "frames")


@dataclass
class _Slot:
    """Host memory of one batch, pinned so that a GPU copies it while the host goes on."""

    batch: Batch
    copied: torch.cuda.Event | None
    """Recorded after the last copy; None without a GPU."""


class StagedBatches(FreshBatches):
    """Batches of new points, the same as those of `FreshBatches`, for steps that read them at a fixed place.

    Arguments: as `FreshBatches`.
    """

    are_static: ClassVar[bool] = True

    def __init__(self, store: SampleStore, config: TrainingConfig, seed: int, device: torch.device) -> None:
        super().__init__(store, config, seed, device)
        self._slots: list[_Slot] = []
        self._staged: Batch | None = None

    def batch(self, step: int | Tensor) -> Batch:
        """Return the batch of one step, which waits until it is ready; for a tensor, the one that was staged last."""
        if not isinstance(step, Tensor):
            return super().batch(step)
        assert self._staged is not None
        return self._staged

    def stage(self, step: int) -> None:
        """Copy the batch of a step to its place on the device, behind all work that was given to the device before.

        Waits until the batch is ready, but not for the device, unless its copies are several steps behind.
        """
        drawn = self.drawn(step)
        if self._staged is None:
            self._staged = _like(drawn, self.device, pinned=False)
            self._slots = [self._new_slot(drawn) for _ in range(_SLOTS)]
        slot = self._slots[step % _SLOTS]
        if slot.copied is not None:
            slot.copied.synchronize()
        for name in _TENSORS:
            host = getattr(slot.batch, name).copy_(getattr(drawn, name))
            getattr(self._staged, name).copy_(host, non_blocking=True)
        if slot.copied is not None:
            slot.copied.record(torch.cuda.current_stream(self.device))

    def _new_slot(self, drawn: Batch) -> _Slot:
        is_cuda = self.device.type == "cuda"
        return _Slot(_like(drawn, torch.device("cpu"), pinned=is_cuda), torch.cuda.Event() if is_cuda else None)


def _like(batch: Batch, device: torch.device, pinned: bool) -> Batch:
    """Return an empty batch of the same shapes."""
    tensors = {name: getattr(batch, name) for name in _TENSORS}
    empty = {
        name: torch.empty(value.shape, dtype=value.dtype, device=device, pin_memory=pinned) for name, value in tensors.items()
    }
    return Batch(**empty, frames=[])
