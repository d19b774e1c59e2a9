"""Where a Broyden search starts: at the images of a query under inverse bone transforms, or at given canonical points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snarfcli.deformer.roots import invert_3x3
from snarfcli.deformer.search_config import SearchConfig

__all__ = ["check_starts", "start_transforms"]


def start_transforms(bone_transforms: Tensor, init_bones: Sequence[int] | None) -> Tensor:
    """Return the upper rows of the inverse transforms of the start bones, [B, I, 12], posed to canonical.

    Args:
        bone_transforms: [B, J, 4, 4], canonical to posed.
        init_bones: numbers of the start bones; None for all.
    """
    # Stacked, since a list as an index would be copied to a GPU, which waits for it.
    chosen = bone_transforms if init_bones is None else torch.stack([bone_transforms[:, bone] for bone in init_bones], 1)
    turn, _ = invert_3x3(chosen[..., :3, :3].reshape(-1, 3, 3))
    shift = -(turn * chosen[..., :3, 3].reshape(-1, 1, 3)).sum(-1)
    return torch.cat([turn, shift[..., None]], -1).reshape(*chosen.shape[:2], 12)


def check_starts(starts: Tensor | None, points: Tensor, search: SearchConfig) -> None:
    """Raise ValueError or TypeError if given starts [B, N, I, 3] do not fit the points [B, N, 3] or the search."""
    if starts is None:
        return
    if search.name == "complete":
        raise ValueError("starts needs search.name 'broyden': a complete search has no starts")
    if search.init_bones is not None:
        raise ValueError(f"search.init_bones: wanted None beside starts, got {list(search.init_bones)}")
    batch, count = points.shape[:2]
    if starts.ndim != 4 or list(starts.shape[:2]) != [batch, count] or starts.shape[3] != 3:
        raise ValueError(f"starts: wanted shape [{batch}, {count}, I, 3] to fit points, got {list(starts.shape)}")
    if starts.dtype != points.dtype:
        raise TypeError(f"starts: wanted the dtype of points, {points.dtype}, got {starts.dtype}")
    if starts.device != points.device:
        raise ValueError(f"starts: wanted the device of points, {points.device}, got {starts.device}")
