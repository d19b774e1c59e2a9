"""How the nodes of the weight grid are shared out among the sides of a subject that is no person in a T-pose."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.deformer import SkinningConfig

__all__ = ["with_grid_sides"]

_FEWEST_NODES = 4


def with_grid_sides(skinning: SkinningConfig, surface: Tensor, skeleton: Skeleton) -> SkinningConfig:
    """Return the settings for a subject's own proportions.

    They are written for SMPL's bodies, wide, high and flat (64 x 64 x 16 nodes). On any other skeleton the longest side takes
    the margin that is meant for x, the shortest that for z, and as many nodes in all are laid out in cells as long as wide: an
    animal is long where a person is flat.

    Args:
        skinning: settings; returned as they are for SMPL's joints.
        surface: [K, 3] canonical surface points, metres.
        skeleton: the subject's.
    """
    if skeleton.names == SMPL_JOINT_NAMES:
        return skinning
    extent = surface.amax(0) - surface.amin(0)
    order = torch.argsort(extent, descending=True, stable=True).tolist()
    margin = [0.0] * 3
    for axis, value in zip(order, skinning.margin_m, strict=True):
        margin[axis] = value
    sides = extent.double() + 2 * torch.tensor(margin, dtype=torch.float64)
    sides = sides.clamp_min(1e-3 * float(sides.max()))
    nodes = torch.tensor(skinning.resolution).prod()
    cell = float((sides.prod() / nodes) ** (1 / 3))
    resolution = [max(_FEWEST_NODES, round(float(side) / cell)) for side in sides]
    return replace(skinning, resolution=resolution, margin_m=margin)
