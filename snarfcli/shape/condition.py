"""The pose condition of canonical points: the angles of all joints, of the joints that move the point, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["CONDITIONS", "ConditionConfig", "joints_of_bones"]

CONDITIONS = ("global", "local", "none")
"""Kinds of pose conditions, see `ConditionConfig.name`."""


@dataclass
class ConditionConfig:
    name: str = "global"
    """global (angles of all joints at every point, as in the papers), local (of the joints that move the point) or none."""
    layer: int | None = None
    """Layer of the canonical shape that gets the condition; null: shape.condition_layer."""
    size: int | None = None
    """Size of the code to which the condition is first reduced; null: shape.condition_size."""


def joints_of_bones(parents: Sequence[int]) -> Tensor:
    """Return which joints condition the points of each bone, [J, J - 1], 0 or 1.

    They are the joint that the bone turns about and the joints of its children. The root is not among the columns: its angles
    are the global orientation, which does not change the shape.
    """
    seen = torch.zeros(len(parents), len(parents))
    for joint, parent in enumerate(parents):
        seen[joint, joint] = 1.0
        if parent >= 0:
            seen[parent, joint] = 1.0
    return seen[:, 1:]
