"""Configuration of a system."""

from __future__ import annotations

from dataclasses import dataclass, field

from snarfcli.deformer import BodySkinningConfig, SearchConfig
from snarfcli.shape import ConditionConfig, ShapeConfig

__all__ = ["AvatarConfig", "ModelConfig"]


@dataclass
class ModelConfig:
    name: str = "fast_snarf"
    """Which system: fast_snarf, snarf, pose_onet, back_lbs, back_d, nasa, piecewise or smpl_nn."""
    blend: str = "logit"
    """How the correspondences of a point are blended in training: logit (softmax-weighted mean of the logits) or probability
    (softmax-weighted mean of the occupancies, as in the papers); only for forward skinning."""
    blend_sharpness: float = 1.0
    """Factor before the softmax of the blend (5 on occupancies in the released code; the papers give no number)."""
    components: int | None = None
    """Number of connected pieces of the canonical shape that a finished avatar keeps, largest first; null keeps all pieces
    that points inside the training meshes need. Only for forward skinning."""
    part_width: int = 40
    """Width of the hidden layers of each part's network (nasa, piecewise)."""
    part_depth: int = 4
    """Number of hidden layers of each part's network."""
    part_code: int = 4
    """Size of the code to which the pose is reduced for each part; 0 for parts that do not deform."""
    part_weight: float = 0.5
    """Weight of the loss that assigns each surface point to one part, by ground-truth skinning weights."""
    part_points: int = 128
    """Number of surface points per frame of a step for that loss."""


@dataclass
class AvatarConfig:
    """Configuration from which the networks of an avatar are built."""

    model: ModelConfig
    skinning: BodySkinningConfig
    search: SearchConfig
    shape: ShapeConfig
    condition: ConditionConfig = field(default_factory=ConditionConfig)
