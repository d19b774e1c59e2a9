"""Untrained avatars of every system with as few numbers as possible, as bases of damaged and hostile files."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import torch

from snarfcli.avatar import Avatar
from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.deformer import BodySkinningConfig, CanonicalGrid, PresetWeights, SearchConfig
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.shape import ConditionConfig, ShapeConfig

__all__ = ["KINDS", "saved", "tiny_avatar", "tiny_skeleton"]

KINDS = ("fast_snarf", "voxel", "symmetric", "preset", "mlp", "grids", "normed", "local", "snarf", "pose_onet", "back_lbs",
         "back_d", "nasa", "piecewise", "smpl_nn")  # fmt: skip
"""The systems, and the kinds of weight fields and shapes of fast_snarf."""


def tiny_skeleton() -> Skeleton:
    """Return three joints in a row along y, the body of which is 0.7 m long."""
    joints = torch.tensor([[0.0, 0, 0], [0, 0.3, 0], [0, 0.5, 0]])
    return Skeleton(("root", "middle", "top"), (-1, 0, 1), joints, torch.zeros(3, 3))


def tiny_avatar(kind: str = "fast_snarf") -> Avatar:
    """Return an untrained avatar of one of `KINDS`: a capsule around the bones, slightly changed by its network."""
    system = kind if kind in ("snarf", "pose_onet", "back_lbs", "back_d", "nasa", "piecewise", "smpl_nn") else "fast_snarf"
    field = {"voxel": "voxel", "symmetric": "voxel", "preset": "preset", "mlp": "mlp"}.get(kind, "distilled")
    is_searched = "mlp" in (field, kind) or kind == "snarf"
    skinning = BodySkinningConfig(
        name=field, resolution=[5, 6, 4], width=6, depth=1, weight_norm=kind == "normed", prior_falloff_m=0.05,
        bone_radius_m=None, symmetric=kind == "symmetric", sharpness=5.0,
        softmax="hierarchical" if kind == "voxel" else "plain",
    )  # fmt: skip
    shape = ShapeConfig(
        width=6, depth=2, activation="relu", skip_layers=[1] if kind == "normed" else [], frequencies=[4.0], condition_layer=1,
        condition_size=2, condition_at_start=False, geometric_init=False, weight_norm=kind == "normed", prior_radius_m=0.1,
        feature_cells_m=[0.3, 0.2] if kind in ("grids", "back_lbs") else [], features=2,
    )  # fmt: skip
    search = SearchConfig("broyden", max_steps=8) if is_searched else SearchConfig()
    condition = ConditionConfig("local" if kind == "local" else "global")
    config = AvatarConfig(ModelConfig(system, part_width=6, part_depth=2, part_code=2), skinning, search, shape, condition)
    skeleton = tiny_skeleton()
    grid = CanonicalGrid(torch.tensor([-0.2, -0.2, -0.2]), torch.tensor([0.2, 0.7, 0.2]))
    generator = np.random.default_rng(0)
    vertices = generator.uniform([-0.1, 0, -0.1], [0.1, 0.5, 0.1], (20, 3)).astype(np.float32)
    weights = generator.dirichlet([1, 1, 1], 20).astype(np.float32)
    template = MeshTemplate(vertices, np.zeros((0, 3), np.int32), weights)
    given = PresetWeights.placeholder(grid, (4, 6, 5), 3) if field == "preset" else None
    torch.manual_seed(0)
    facts: dict[str, Any] = {"data": "builtin", "subject": "tiny", "seed": 0, "steps": 10, "validation": {"iou_bbox": 0.5}}
    avatar = Avatar(config, skeleton, grid, torch.from_numpy(vertices), facts, field=given, template=template)
    return avatar.to("cpu")


def saved(content: Any) -> bytes:
    """Return the bytes that `torch.save` writes for a content."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()
