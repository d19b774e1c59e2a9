"""Avatars without a network, for tests: a subclass defines the canonical shape and the skinning weights as functions."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from snarfcli.avatar import Avatar
from snarfcli.bodies import Skeleton
from snarfcli.deformer import BodySkinningConfig, CanonicalGrid, SearchConfig
from snarfcli.deformer.skinning import skin
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.models.system import System
from snarfcli.shape import ShapeConfig

__all__ = ["AnalyticAvatar", "capsule"]


def capsule(points: Tensor, start: tuple, end: tuple, radius: float) -> Tensor:
    """Return the distance to the surface of a capsule, positive inside, metres."""
    start_t, end_t = points.new_tensor(start), points.new_tensor(end)
    along = end_t - start_t
    share = ((points - start_t) @ along / (along @ along)).clamp(0, 1)
    return radius - (points - start_t - share[:, None] * along).norm(dim=1)


class _NoNetwork(System):
    """A system with a canonical box and skinning weights, and without parameters."""

    has_skinning_weights: ClassVar[bool] = True

    def __init__(self, config: AvatarConfig, skeleton: Skeleton, grid: CanonicalGrid) -> None:
        super().__init__(config, skeleton)
        self._grid = grid

    @property
    def grid(self) -> CanonicalGrid:
        return self._grid


class AnalyticAvatar(Avatar):
    """An avatar whose canonical shape and skinning weights are functions of the canonical point.

    A subclass overrides `canonical_logits` and `skinning_weights`, and `query` and `posed_box` for a posed field.
    """

    def __init__(self, skeleton: Skeleton, grid: CanonicalGrid, **facts: str) -> None:
        config = AvatarConfig(ModelConfig(), BodySkinningConfig(), SearchConfig(), ShapeConfig())
        self.config, self.skeleton, self.facts, self.template = config, skeleton, dict(facts), None
        self.model = _NoNetwork(config, skeleton, grid)
        self._derived = {}

    def canonical_logits(self, canonical: Tensor, pose: Tensor) -> Tensor:
        raise NotImplementedError

    def skinning_weights(self, canonical: Tensor) -> Tensor:
        raise NotImplementedError

    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        return skin(canonical, self.skinning_weights(canonical), bone_transforms)
