"""Divide the nodes of the weight grid among the sides of its box, for skeletons other than SMPL's."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.deformer.skinning_config import BodySkinningConfig

__all__ = ["with_grid_sides"]

_FEWEST_NODES = 4


def with_grid_sides(skinning: BodySkinningConfig, surface: Tensor, skeleton: Skeleton) -> BodySkinningConfig:
    """Adapt the settings of the grid to the proportions of a subject.

    The settings are for SMPL's bodies, which are wide, high and flat (64 x 64 x 16 nodes). For any other skeleton the longest
    side gets the margin of x, the shortest that of z, and the same total number of nodes is laid out in cells that are about
    cubes: an animal is long where a person is flat.

    Args:
        skinning: settings; returned unchanged for SMPL's joints.
        surface: [K, 3], canonical surface points, metres.
        skeleton: the subject's skeleton.
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
