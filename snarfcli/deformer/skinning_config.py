"""Settings of the skinning weights."""

from __future__ import annotations

from dataclasses import dataclass, field

from snarfcli.field_docs import documented

__all__ = ["FIELDS", "BodySkinningConfig", "SkinningConfig"]

FIELDS = ("distilled", "voxel", "mlp", "preset")
"""Names of the weight fields."""


@documented
@dataclass
class SkinningConfig:
    """Settings of a weight field."""

    name: str = "distilled"
    """Weight field: distilled (a network evaluated at the grid nodes), voxel (optimised at the nodes), mlp (a network that is
    searched directly, as in SNARF) or preset (given, not trained)."""
    softmax: str = "plain"
    """How logits become weights: plain, or hierarchical down the tree of joints; no effect on preset weights."""
    resolution: list[int] = field(default_factory=lambda: [64, 64, 16])
    """Grid nodes along x, y, z. For a skeleton other than SMPL's the same total is distributed by the sides of its box."""
    width: int = 128
    """Width of the network's hidden layers."""
    depth: int = 4
    """Number of hidden layers."""
    sharpness: float = 20.0
    """Factor before the softmax over the bones."""
    weight_norm: bool = True
    """Whether the network's layers are weight-normalised."""


@documented
@dataclass
class BodySkinningConfig(SkinningConfig):
    """Settings of the weight field of a body: also how its grid is laid around the body, and how it is trained."""

    margin_m: list[float] = field(default_factory=lambda: [0.12, 0.12, 0.20])
    """Margin of the grid's box around the canonical body on either side, along x, y, z, metres."""
    bone_radius_m: float | None = 0.22
    """Cells with a corner at most this far from a bone are searched at first, metres; null always searches every cell."""
    surface_radius_m: float = 0.12
    """Cells at most this far from the rough points of the body that give the grid's box are searched too, metres."""
    prior_falloff_m: float | None = None
    """Prior of the field: weights that fall by a factor e over this distance to a bone, metres; null for no prior."""
    smoothness: float = 0.0
    """Weight of the loss on differences of voxel weights between neighbouring nodes."""
    symmetric: bool = False
    """Whether voxel weights are the same on the left and on the right, if the skeleton is symmetric."""
    weights_file: str | None = None
    """Preset weights: .npz file with vertices [V, 3], canonical pose, metres, and weights [V, J]; kept in the avatar."""
