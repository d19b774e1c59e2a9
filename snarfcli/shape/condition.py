"""What of the pose each canonical point is told: every joint's angles, those of the joints that move it, or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["CONDITIONS", "ConditionConfig", "joints_of_bones"]

CONDITIONS = ("global", "local", "none")


@dataclass
class ConditionConfig:
    name: str = "global"
    """global (every joint's angles at every point, as in the papers), local (those of the joints that move it) or none."""
    layer: int | None = None
    """Layer of the canonical shape that the condition enters; null: shape.condition_layer."""
    size: int | None = None
    """Size of the code that it is reduced to before; null: shape.condition_size."""


def joints_of_bones(parents: Sequence[int]) -> Tensor:
    """Return which joints the points of each bone see, [J, J - 1], 0 or 1.

    A bone is bounded by the joint that it turns about and by those of its children; the root's angles are the global
    orientation, which changes no shape, so it is not among the columns.
    """
    seen = torch.zeros(len(parents), len(parents))
    for joint, parent in enumerate(parents):
        seen[joint, joint] = 1.0
        if parent >= 0:
            seen[parent, joint] = 1.0
    return seen[:, 1:]
