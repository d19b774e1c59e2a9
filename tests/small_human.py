"""An untrained avatar with the skeleton of the built-in body, as a stand-in for that of `make demo`."""

from __future__ import annotations

import torch

from snarfcli.avatar import Avatar
from snarfcli.bodies import builtin_body
from snarfcli.deformer import BodySkinningConfig, CanonicalGrid, SearchConfig
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.shape import ConditionConfig, ShapeConfig

__all__ = ["small_human"]


def small_human() -> Avatar:
    """Return the avatar: capsules around the bones, hardly changed by a network; weights by the distance to the bones."""
    skinning = BodySkinningConfig(name="voxel", resolution=[32, 32, 12], prior_falloff_m=0.05, bone_radius_m=0.2)
    shape = ShapeConfig(
        width=8, depth=2, activation="relu", skip_layers=[], frequencies=[], condition_layer=1, condition_size=2,
        condition_at_start=False, geometric_init=False, weight_norm=False, prior_radius_m=0.1, feature_cells_m=[], features=2,
    )  # fmt: skip
    config = AvatarConfig(ModelConfig("fast_snarf"), skinning, SearchConfig(), shape, ConditionConfig("global"))
    skeleton = builtin_body().skeleton()
    grid = CanonicalGrid.around(skeleton.canonical_joints, [0.25, 0.25, 0.25])
    torch.manual_seed(0)
    facts = {"data": "builtin", "subject": "50002", "seed": 0, "steps": 1, "validation": {"iou_bbox": 0.5}}
    return Avatar(config, skeleton, grid, skeleton.canonical_joints, facts)
