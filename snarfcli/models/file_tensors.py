"""Check tensors of avatars and checkpoints, which may be from any file, before they are used."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from snarfcli.models.system import System
from snarfcli.texts import one_line

__all__ = ["FARTHEST_M", "load_state", "read_state", "read_tensor"]

FARTHEST_M = 1e5
"""Limit of places in files, metres."""

_SAME_BOX_M = 1e-4  # another machine rounds the points differently from which a resumed training takes the box


def read_tensor(
    value: Any, name: str, shape: Sequence[int | None], dtype: torch.dtype = torch.float32, below: float = torch.inf
) -> Tensor:
    """Return a tensor from a file.

    Args:
        value: from the file.
        name: of the tensor, for messages.
        shape: wanted shape; None for any length.
        dtype: wanted type.
        below: limit of the magnitude of its values.

    Raises:
        ValueError: it is no tensor, or has another shape, another type, or values that are not finite or too large.
    """
    came = list(value.shape)[:9] if isinstance(value, Tensor) else type(value).__name__
    if not isinstance(value, Tensor) or value.ndim != len(shape):
        raise ValueError(f"{name}: wanted shape {_shown(shape)}, got {came}")
    if not all(wanted in (None, got) for wanted, got in zip(shape, value.shape, strict=True)):
        raise ValueError(f"{name}: wanted shape {_shown(shape)}, got {came}")
    if value.dtype != dtype:
        raise ValueError(f"{name}: wanted dtype {dtype}, got {value.dtype}")
    if not bool((value.abs() < below).all() if below < torch.inf else value.isfinite().all()):
        raise ValueError(f"{name}: wanted finite numbers{f' below {below:g}' if below < torch.inf else ''}, got others")
    return value


def read_state(content: Any) -> dict[str, Tensor]:
    """Return the tensors of a model in a file.

    Raises:
        ValueError: there is something else, or a tensor has values that are not finite.
    """
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        raise ValueError("state: wanted tensors by name, got something else")
    for name, value in content.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            count = int((~value.isfinite()).sum())
            raise ValueError(f"state.{one_line(str(name), 60)}: {count} of {value.numel()} numbers are NaN or infinite")
    return content


def load_state(model: System, state: dict[str, Tensor]) -> None:
    """Load the state of a file, whose tensors must have the types of the model's.

    Raises:
        RuntimeError, ValueError: the state does not fit the model.
    """
    for name, own in model.state_dict().items():
        if name in state and state[name].dtype != own.dtype:
            raise ValueError(f"state.{name}: wanted dtype {own.dtype}, got {state[name].dtype}")
    for name, _ in model.named_buffers():  # places and sizes, unlike parameters
        if name in state and state[name].is_floating_point() and not bool((state[name].abs() < FARTHEST_M).all()):
            raise ValueError(f"state.{name}: wanted numbers below {FARTHEST_M:g}, got others")
    box = model.grid.lower.clone(), model.grid.upper.clone()
    model.load_state_dict(state)
    if not all((a - b).abs().max() < _SAME_BOX_M for a, b in zip(box, (model.grid.lower, model.grid.upper), strict=True)):
        raise ValueError("state: its canonical box is another than that of the avatar")


def _shown(shape: Sequence[int | None]) -> str:
    return f"[{', '.join('any' if length is None else str(length) for length in shape)}]"
