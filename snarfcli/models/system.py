"""The interface of all systems: what training, evaluation and meshing ask of a posed occupancy field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid, SearchConfig
from snarfcli.deformer.skinning import skin
from snarfcli.models.settings import AvatarConfig
from snarfcli.precision import network_precision
from snarfcli.shape import CONDITIONS, OccupancyNetwork, joints_of_bones
from snarfcli.shape.inference import can_evaluate, evaluate

__all__ = ["NO_CORRESPONDENCE", "FieldSamples", "Found", "System", "pose_angles"]

NO_CORRESPONDENCE = -30.0
"""Logit of a point that no canonical point is moved onto: certainly outside."""

_POINTS_AT_ONCE = 32_768  # canonical points in one call of the shape network; smaller calls stay in the cache
_ROUND_NUMBER = 512  # of points in training: oneDNN compiles its matrix products anew for every size it has not met


@dataclass
class FieldSamples:
    """Values of the posed field at B x N query points."""

    logits: Tensor
    """[B, N], occupied where positive; `NO_CORRESPONDENCE` where there is none."""
    found: Tensor
    """Which points have a correspondence, bool [B, N]."""
    counts: Tensor
    """Number of correspondences of each point, [B, N]."""

    @property
    def correspondences(self) -> int:
        """Number of correspondences of all points."""
        return int(self.counts.sum())


class Found:
    """Where posed points come from: what a system's `find` returns and its `shape_at` takes."""


def pose_angles(pose: Tensor) -> Tensor:
    """Return the joint angles of poses [B, J, 3] without the global orientation, in half turns, [B, 3 (J - 1)]."""
    return pose[:, 1:].flatten(1) / torch.pi


class System(nn.Module):
    """A posed occupancy field of one subject that can be trained.

    A system says what it does differently by overriding methods; those here belong to systems with a canonical shape that needs
    no care beyond its gradients.

    Args:
        config: architecture.
        skeleton: joint tree and canonical pose.
    """

    needs_template: ClassVar[bool] = False
    """Whether training needs the subject's mesh with its true skinning weights."""
    keeps_template: ClassVar[bool] = False
    """Whether the trained avatar needs it too, so that it is saved with it."""
    has_canonical_shape: ClassVar[bool] = True
    """Whether there is a surface in the canonical frame."""
    has_skinning_weights: ClassVar[bool] = False
    """Whether there are skinning weights of canonical points, so that canonical points can be moved."""
    conditions: ClassVar[tuple[str, ...]] = CONDITIONS
    """Ways in which its canonical shape can depend on the pose."""
    shape: OccupancyNetwork
    """The network of the canonical shape."""
    _joints_of_bones: Tensor

    def __init__(self, config: AvatarConfig, skeleton: Skeleton) -> None:
        super().__init__()
        self.config = config
        name = config.condition.name
        if name not in CONDITIONS:
            raise ValueError(f"condition.name must be one of {', '.join(CONDITIONS)}, got {name!r}")
        if name not in self.conditions:
            known = ", ".join(self.conditions)
            raise ValueError(f"model {config.model.name} has no skinning weights for condition={name}; choose from {known}")
        self.num_bones = skeleton.num_joints
        self.register_buffer("_joints_of_bones", joints_of_bones(skeleton.parents), persistent=False)

    def _make_shape(self, bones: Tensor) -> OccupancyNetwork:
        """Return the network that says what is occupied; `bones` [S, 2, 3] are the canonical ends of the bones, metres."""
        shape, condition = self.config.shape, self.config.condition
        if condition.layer is not None:
            shape = replace(shape, condition_layer=condition.layer)
        if condition.size is not None:
            shape = replace(shape, condition_size=condition.size)
        pose_size = 0 if condition.name == "none" else 3 * (self.num_bones - 1)
        return OccupancyNetwork(shape, pose_size, bones)

    # ---------------------------------------------------------------- the field
    def forward(self, points: Tensor, bone_transforms: Tensor, pose: Tensor, precision: str = "highest") -> FieldSamples:
        """Evaluate the posed field: `find`, then `shape_at`.

        Args:
            points: [B, N, 3], posed space, metres.
            bone_transforms: [B, J, 4, 4], canonical to posed.
            pose: [B, J, 3] axis-angle, radians.
            precision: of the shape network (see `PRECISIONS`); `find` always runs in full float32.
        """
        return self.shape_at(self.find(points, bone_transforms, pose), pose, precision)

    def find(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> Found:
        """Go back to the canonical frame, in full float32; arguments as in `forward`."""
        raise NotImplementedError

    def shape_at(self, found: Found, pose: Tensor, precision: str = "highest") -> FieldSamples:
        """Evaluate the shape network where `find` has led."""
        raise NotImplementedError

    def condition(self, pose: Tensor) -> Tensor:
        """Return the pose condition [B, C] of the canonical shape."""
        return pose_angles(pose)

    @property
    def depends_on_weights(self) -> bool:
        """Whether the canonical shape depends on the skinning weights of a point."""
        return self.config.condition.name == "local"

    def canonical_logits(
        self, canonical: Tensor, condition: Tensor, pose: Tensor, precision: str = "highest", weights: Tensor | None = None
    ) -> Tensor:
        """Return the canonical occupancy logits [M] of points [M, 3] under `condition[pose]` ([B, C] and [M]).

        Args:
            canonical: [M, 3], metres.
            condition: [B, C].
            pose: index of each point's pose, [M].
            precision: of the network, but not where the native library evaluates it, which is in full float32 and faster.
            weights: skinning weights of the points [M, J], used if `depends_on_weights`; None to evaluate them here.
        """
        seen = None
        if self.depends_on_weights:
            with torch.no_grad():
                weights = self.skinning_weights(canonical) if weights is None else weights
            seen = self.seen_joints(weights)
        if can_evaluate(self.shape, canonical):
            return evaluate(self.shape, canonical, condition, pose, seen)
        with network_precision(precision, canonical.device):
            if torch.is_grad_enabled():
                extra = -len(canonical) % _ROUND_NUMBER if canonical.device.type == "cpu" else 0
                seen = None if seen is None else F.pad(seen, (0, 0, 0, extra))
                padded = self.shape(F.pad(canonical, (0, 0, 0, extra)), condition, F.pad(pose, (0, extra)), seen)
                return padded[: len(canonical)].to(canonical.dtype)
            parts = [values.split(_POINTS_AT_ONCE) for values in (canonical, pose)]
            parts.append([None] * len(parts[0]) if seen is None else seen.split(_POINTS_AT_ONCE))
            logits = [self.shape(points, condition, index, part) for points, index, part in zip(*parts, strict=True)]
            return torch.cat(logits).to(canonical.dtype)

    @torch.no_grad()
    def seen_joints(self, weights: Tensor) -> Tensor:
        """Return how much points of skinning weights [M, J] see of each joint but the root, [M, J - 1], 0 to 1.

        A point sees the joints that bound the bones which move it. No gradient reaches the weights this way: that the shape
        could be mended by seeing other joints is no reason for a point to follow other bones.

        Source: after SCANimate (Saito et al., CVPR 2021), which masks the pose by skinning weights.
        """
        return weights @ self._joints_of_bones

    # ---------------------------------------------------------------- training
    def bone_logits(
        self,
        points: Tensor,
        owner: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        precision: str = "highest",
        found: Found | None = None,
    ) -> Tensor:
        """Return occupancy logits at points of the bones, for the loss that fills them (SNARF Sec. 3.3).

        Args:
            points: [M, 3], canonical frame, metres.
            owner: the bone that each moves with, [M].
            bone_transforms: [B, J, 4, 4], canonical to posed.
            pose: [B, J, 3].
            precision: of the network.
            found: from `find` with the same parameters; what it has evaluated is then not evaluated again.
        """
        index = torch.arange(len(points), device=points.device) % len(pose)
        return self.canonical_logits(points, self.condition(pose), index, precision)

    def joint_weights(self, joints: Tensor, bone_transforms: Tensor, pose: Tensor) -> Tensor | None:
        """Return the skinning weights at the joints, [..., J, J], for the loss on them (SNARF Sec. 3.3); None: not trained.

        Args:
            joints: [J, 3], canonical frame, metres.
            bone_transforms: [B, J, 4, 4].
            pose: [B, J, 3].
        """
        return None

    def extra_losses(
        self, bone_transforms: Tensor, pose: Tensor, generator: torch.Generator, precision: str = "highest"
    ) -> dict[str, Tensor]:
        """Return losses of the system's own, weighted, by name."""
        return {}

    def far_points(self, count: int, bone_transforms: Tensor, generator: torch.Generator) -> Tensor | None:
        """Return posed points [B, count, 3] at which the field may be occupied, samples or not; None: nowhere in particular."""
        return None

    def refresh_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Look again, every now and then in training, where the shape is in poses [P, J, 3]."""

    def tighten_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Look for the last time where the shape is in poses [P, J, 3]."""

    def freeze(self) -> None:
        """Prepare for use after training: evaluate once what does not depend on the pose."""
        self.eval()

    # ---------------------------------------------------------------- use
    @property
    def grid(self) -> CanonicalGrid:
        """The canonical box that holds the body."""
        raise NotImplementedError

    @property
    def search(self) -> SearchConfig | None:
        """How correspondences are found; None in a system without a search."""
        return None

    def choose_search(self, search: SearchConfig) -> None:
        """Find correspondences in another way from now on.

        Raises:
            ValueError: the system has no search, or cannot use this one.
        """
        raise ValueError(f"model {self.config.model.name} searches no correspondences, got search.name {search.name!r}")

    def is_searched(self, canonical: Tensor) -> Tensor:
        """Return at which canonical points [N, 3] the shape was trained, bool [N]."""
        return ((canonical >= self.grid.lower) & (canonical <= self.grid.upper)).all(1)

    def skinning_weights(self, canonical: Tensor) -> Tensor:
        """Return the skinning weights [N, J] at canonical points [N, 3].

        Raises:
            ValueError: the system has none.
        """
        raise ValueError(f"model {self.config.model.name} has no skinning weights in the canonical frame")

    def skin(self, canonical: Tensor, bone_transforms: Tensor) -> Tensor:
        """Move canonical points [N, 3] into one pose [J, 4, 4]."""
        return skin(canonical, self.skinning_weights(canonical), bone_transforms)

    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners (lower [3], upper [3]) of a box that holds the whole body in one pose [J, 4, 4], metres."""
        raise NotImplementedError
