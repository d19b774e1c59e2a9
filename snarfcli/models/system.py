"""Interface of all systems: a posed occupancy field, as training, evaluation and meshing use it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor, nn

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid, NodeWeights, SearchConfig
from snarfcli.deformer.skinning import skin
from snarfcli.draws import Draws
from snarfcli.models.settings import AvatarConfig
from snarfcli.precision import network_precision
from snarfcli.shape import CONDITIONS, OccupancyNetwork, joints_of_bones
from snarfcli.shape.inference import can_evaluate, evaluate

__all__ = ["NO_CORRESPONDENCE", "FieldSamples", "Found", "System", "pose_angles"]

NO_CORRESPONDENCE = -30.0
"""Logit of a point without a correspondence, which is certainly outside."""

_POINTS_AT_ONCE = 32_768  # canonical points in one call of the shape network; smaller calls stay in the cache


@dataclass
class FieldSamples:
    """Values of the posed field at B x N query points."""

    logits: Tensor
    """[B, N], occupied where positive; `NO_CORRESPONDENCE` for points without one."""
    found: Tensor
    """[B, N], bool, whether each point has a correspondence."""
    counts: Tensor
    """[B, N], number of correspondences per point."""

    @property
    def correspondences(self) -> Tensor:
        """Number of correspondences of all points, []."""
        return self.counts.sum()


class Found:
    """Where posed points come from: what a system's `find` returns and its `shape_at` takes."""

    @property
    def total(self) -> Tensor | None:
        """Number of correspondences found, [1], also of those beyond a capacity; None if each point has one."""
        return None


def pose_angles(pose: Tensor) -> Tensor:
    """Return the joint angles of poses [B, J, 3] without the global orientation, in half turns, [B, 3 (J - 1)]."""
    return pose[:, 1:].flatten(1) / torch.pi


class System(nn.Module):
    """A posed occupancy field of one subject that can be trained.

    A system overrides the methods in which it differs; those here fit systems with a canonical shape that is trained by its
    gradients alone.

    Args:
        config: architecture.
        skeleton: joint tree and canonical pose.
    """

    needs_template: ClassVar[bool] = False
    """Whether training needs the subject's mesh with ground-truth skinning weights."""
    keeps_template: ClassVar[bool] = False
    """Whether the trained avatar needs that mesh too, so that it is saved in the avatar's file."""
    has_canonical_shape: ClassVar[bool] = True
    """Whether there is a surface in the canonical frame."""
    has_skinning_weights: ClassVar[bool] = False
    """Whether canonical points have skinning weights, so that they can be moved."""
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
            raise ValueError(f"condition.name: wanted {', '.join(CONDITIONS[:-1])} or {CONDITIONS[-1]}, got {name!r}")
        if name not in self.conditions:
            known = ", ".join(self.conditions)
            raise ValueError(f"model {config.model.name} has no skinning weights for condition={name}; choose from {known}")
        self.num_bones = skeleton.num_joints
        self.register_buffer("_joints_of_bones", joints_of_bones(skeleton.parents), persistent=False)

    def _make_shape(self, bones: Tensor, box: tuple[Tensor, Tensor]) -> OccupancyNetwork:
        """Return the occupancy network.

        Args:
            bones: [S, 2, 3], canonical ends of the bones, metres.
            box: corners (lower [3], upper [3]) of the canonical box, metres.
        """
        shape, condition = self.config.shape, self.config.condition
        if condition.layer is not None:
            shape = replace(shape, condition_layer=condition.layer)
        if condition.size is not None:
            shape = replace(shape, condition_size=condition.size)
        pose_size = 0 if condition.name == "none" else 3 * (self.num_bones - 1)
        return OccupancyNetwork(shape, pose_size, bones, box)

    # ---------------------------------------------------------------- the field
    def forward(self, points: Tensor, bone_transforms: Tensor, pose: Tensor, precision: str = "highest") -> FieldSamples:
        """Evaluate the posed field: `find`, then `shape_at`.

        Args:
            points: [B, N, 3], posed space, metres.
            bone_transforms: [B, J, 4, 4], canonical to posed.
            pose: [B, J, 3], axis-angle, radians.
            precision: of the shape network (see `PRECISIONS`); `find` always runs in full float32.
        """
        return self.shape_at(self.find(points, bone_transforms, pose), pose, precision)

    def node_weights(self) -> NodeWeights | None:
        """Evaluate the skinning weights that `find` and `far_points` share; None in a system that shares none."""
        return None

    def find(
        self,
        points: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        weights: NodeWeights | None = None,
        capacity: int | None = None,
    ) -> Found:
        """Go back to the canonical frame, in full float32; arguments as in `forward`.

        Args:
            weights: from `node_weights`, if they have been evaluated already.
            capacity: maximum number of correspondences, which fixes the shapes of what follows (see `has_fixed_shapes`); None
                for as many as there are. No effect in a system with one for each point.
        """
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
            pose: [M], index of each point's pose.
            precision: of the network; no effect where the native library evaluates it on a CPU, in full float32 and faster.
            weights: skinning weights of the points [M, J], used if `depends_on_weights`; None to evaluate them here.
        """
        seen = None
        if self.depends_on_weights:
            with torch.no_grad():
                weights = self.skinning_weights(canonical) if weights is None else weights
            seen = self.seen_joints(weights)
        if can_evaluate(self.shape, canonical):
            return evaluate(self.shape, canonical, condition, pose, seen, precision)
        with network_precision(precision, canonical.device):
            if torch.is_grad_enabled():
                return self.shape(canonical, condition, pose, seen).to(canonical.dtype)
            parts = [values.split(_POINTS_AT_ONCE) for values in (canonical, pose)]
            parts.append([None] * len(parts[0]) if seen is None else seen.split(_POINTS_AT_ONCE))
            logits = [self.shape(points, condition, index, part) for points, index, part in zip(*parts, strict=True)]
            return torch.cat(logits).to(canonical.dtype)

    @torch.no_grad()
    def seen_joints(self, weights: Tensor) -> Tensor:
        """Return the share of each joint but the root in the condition of points with skinning weights [M, J], [M, J - 1].

        A point depends on the joints at the ends of the bones that move it. No gradient reaches the weights this way: a better
        shape under other joints is no reason for a point to follow other bones.

        Source: after SCANimate (Saito et al., CVPR 2021), which masks the pose by skinning weights.
        """
        return weights @ self._joints_of_bones

    # ---------------------------------------------------------------- training
    @property
    def has_fixed_shapes(self) -> bool:
        """Whether all tensors of a step have shapes known in advance, given a capacity for `find`; needed for a capture."""
        return True

    def keep_room(self) -> None:
        """Keep what changes between steps in its place in memory, as long as it fits; called before steps are captured."""

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
            owner: [M], the bone that each point moves with.
            bone_transforms: [B, J, 4, 4], canonical to posed.
            pose: [B, J, 3].
            precision: of the network.
            found: from `find` with the same parameters; what it has evaluated is then not evaluated again.
        """
        index = torch.arange(len(points), device=points.device) % len(pose)
        return self.canonical_logits(points, self.condition(pose), index, precision)

    def joint_weights(self, joints: Tensor, bone_transforms: Tensor, pose: Tensor) -> Tensor | None:
        """Return the skinning weights at the joints, [..., J, J], for their loss (SNARF Sec. 3.3); None if not trained.

        Args:
            joints: [J, 3], canonical frame, metres.
            bone_transforms: [B, J, 4, 4].
            pose: [B, J, 3].
        """
        return None

    def extra_losses(
        self,
        bone_transforms: Tensor,
        pose: Tensor,
        draws: Draws,
        precision: str = "highest",
        found: Found | None = None,
    ) -> dict[str, Tensor]:
        """Return the losses that only this system has, weighted, by name.

        Args:
            bone_transforms: [B, J, 4, 4].
            pose: [B, J, 3].
            draws: random numbers.
            precision: of the networks.
            found: from `find` with the same parameters; what it has evaluated is then not evaluated again.
        """
        return {}

    def agreement_loss(
        self,
        pose: Tensor,
        made_up: Tensor,
        count: int,
        draws: Draws,
        precision: str = "highest",
        found: Found | None = None,
        masks: bool = False,
    ) -> Tensor | None:
        """Return a loss that keeps the canonical shape in made-up poses where training poses agree; None if not known.

        Args:
            pose: [B, J, 3], of training frames.
            made_up: [P, J, 3].
            count: number of canonical points.
            draws: random numbers.
            precision: of the network.
            found: from `find` with the same parameters; what it has evaluated is then not evaluated again.
            masks: whether points that do not count are masked, so that all shapes are fixed, instead of left out.
        """
        return None

    def far_points(
        self, count: int, bone_transforms: Tensor, draws: Draws, weights: NodeWeights | None = None
    ) -> Tensor | None:
        """Return posed points [B, count, 3] where the field may be occupied, also away from samples; None if not known.

        Args:
            weights: from `node_weights`, if they have been evaluated already.
        """
        return None

    def refresh_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Recompute the active cells from the current shape in poses [P, J, 3]; called periodically in training."""

    def extend_weights(self, pose: Tensor, precision: str = "highest") -> tuple[nn.Parameter, Tensor] | None:
        """Replace the skinning weights away from the surface in poses [P, J, 3]; called periodically in training.

        Returns:
            The parameter that has changed, and which of its rows, bool; None if nothing has changed.
        """
        return None

    def tighten_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Shrink the active cells to the final shape in poses [P, J, 3]."""

    def drop_pieces(self, pose: Tensor, inside: Iterable[tuple[Found, Tensor]], precision: str = "highest") -> int:
        """Drop pieces of the final shape in poses [P, J, 3] that do not belong to the subject; return their number.

        Args:
            pose: [P, J, 3].
            inside: what `find` returned for points inside the training meshes, and the poses [B, J, 3] there.
            precision: of the network.
        """
        return 0

    def freeze(self) -> None:
        """Prepare for use after training: compute what does not depend on the pose."""
        self.eval()

    # ---------------------------------------------------------------- use
    @property
    def grid(self) -> CanonicalGrid:
        """The canonical box that holds the body."""
        raise NotImplementedError

    @property
    def search(self) -> SearchConfig | None:
        """Settings of the correspondence search; None in a system without one."""
        return None

    def choose_search(self, search: SearchConfig) -> None:
        """Change the settings of the correspondence search.

        Raises:
            ValueError: the system has no search, or cannot use this one.
        """
        raise ValueError(
            f"search: wanted none, since model {self.config.model.name} searches no correspondences, got {search.name}"
        )

    def is_searched(self, canonical: Tensor) -> Tensor:
        """Return whether the shape was trained at canonical points [N, 3], [N], bool."""
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
