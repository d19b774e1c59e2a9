"""Fast-SNARF: canonical occupancy moved by forward skinning on a weight grid (Fast-SNARF Sec. 3-4, SNARF Sec. 3)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarfcli.bodies import Skeleton
from snarfcli.deformer import (
    BonePrior,
    CanonicalGrid,
    Correspondences,
    ForwardDeformer,
    SearchConfig,
    SkinningConfig,
    cells_near,
)
from snarfcli.deformer.cells import corners_of
from snarfcli.models.extent import bone_segments, weight_segments
from snarfcli.precision import network_precision
from snarfcli.shape import CONDITIONS, ConditionConfig, OccupancyNetwork, ShapeConfig, joints_of_bones

__all__ = ["AvatarConfig", "FastSnarf", "FieldSamples", "ModelConfig", "NO_CORRESPONDENCE", "blend"]

NO_CORRESPONDENCE = -30.0
"""Logit of a point that no canonical point is moved onto: certainly outside."""

_POINTS_AT_ONCE = 32_768  # canonical points in one call of the shape network; smaller calls stay in the cache
_ROUND_NUMBER = 512  # of points in training: oneDNN compiles its matrix products anew for every size it has not met
_SAMPLES_M = 0.04  # most distance of the samples that judge a cell; a wrist is 5 cm thick
_KEPT_RADIUS_M = 0.1  # cells with a corner this near to a bone are searched whatever the field says
_GROWTH_M = 0.06  # how far the cells searched in training reach beyond what might be occupied
_GROWTH_LOGIT = -3.0  # what might be occupied in training: 5 %
_FINAL_M = 0.04
_FINAL_LOGIT = -2.0  # what might be occupied afterwards, in a pose not sampled: 12 %


@dataclass
class ModelConfig:
    name: str = "fast_snarf"
    """Which system."""
    blend: str = "logit"
    """How correspondences of one point are blended in training: logit (softmax-weighted mean of the logits) or
    probability (softmax-weighted mean of the occupancies, as in the papers)."""
    blend_sharpness: float = 1.0
    """Factor before the softmax of the blend (5 on occupancies in the released code)."""


@dataclass
class AvatarConfig:
    """All that is needed to build an avatar's networks again."""

    model: ModelConfig
    skinning: SkinningConfig
    search: SearchConfig
    shape: ShapeConfig
    condition: ConditionConfig = field(default_factory=ConditionConfig)


@dataclass
class FieldSamples:
    """Values of the posed field at B x N query points."""

    logits: Tensor
    """[B, N], occupied where positive; `NO_CORRESPONDENCE` where there is none."""
    found: Tensor
    """Which points have a correspondence, bool [B, N]."""
    correspondences: int
    """Number of correspondences of all points."""
    search_s: float
    """Seconds spent on the correspondence search."""
    shape_s: float
    """Seconds spent on the shape network."""


class FastSnarf(nn.Module):
    """Posed occupancy by correspondence search and a canonical occupancy network.

    Args:
        config: architecture.
        skeleton: joint tree and canonical pose.
        grid: canonical box of the skinning weights.
        surface: rough points of the body, [K, 3], canonical, metres; with the bones they say where to search at first.
        field: weight field to use instead of the one that `config.skinning` describes; preset weights need it.
    """

    def __init__(
        self,
        config: AvatarConfig,
        skeleton: Skeleton,
        grid: CanonicalGrid,
        surface: Tensor,
        field: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        if config.model.blend not in ("logit", "probability"):
            raise ValueError(f"model.blend must be logit or probability, got {config.model.blend!r}")
        self.config = config
        skinning, bones, num_bones = config.skinning, bone_segments(skeleton), skeleton.num_joints
        active = kept = prior = None
        if skinning.bone_radius_m is not None:
            width, height, depth = skinning.resolution
            points = surface[:, None].expand(-1, 2, -1)
            places = [(bones, skinning.bone_radius_m), (points, skinning.surface_radius_m)]
            active = cells_near(grid, (depth, height, width), places)
            kept = cells_near(grid, (depth, height, width), [(bones, min(skinning.bone_radius_m, _KEPT_RADIUS_M))])
        if skinning.prior_falloff_m is not None:
            prior = BonePrior(*weight_segments(skeleton), num_bones, skinning.prior_falloff_m)
        self.deformer = ForwardDeformer(
            grid, num_bones, skinning, config.search, active, prior, parents=skeleton.parents, field=field
        )
        self.register_buffer("_kept_cells", kept, persistent=False)
        if config.condition.name not in CONDITIONS:
            raise ValueError(f"condition.name must be one of {', '.join(CONDITIONS)}, got {config.condition.name!r}")
        pose_size = 0 if config.condition.name == "none" else 3 * (num_bones - 1)
        self.shape = OccupancyNetwork(config.shape, pose_size, bones)
        self.register_buffer("_joints_of_bones", joints_of_bones(skeleton.parents), persistent=False)

    def condition(self, pose: Tensor) -> Tensor:
        """Return the pose condition [B, 3 (J - 1)]: joint angles without the global orientation, in half turns."""
        return pose[:, 1:].flatten(1) / torch.pi

    def forward(
        self, points: Tensor, bone_transforms: Tensor, pose: Tensor, precision: str = "highest"
    ) -> FieldSamples:
        """Evaluate the posed field: blended over the correspondences in training, their maximum otherwise.

        Args:
            points: [B, N, 3], posed space, metres.
            bone_transforms: [B, J, 4, 4], canonical to posed.
            pose: [B, J, 3] axis-angle, radians.
            precision: of the shape network (see `PRECISIONS`); the search always runs in full float32.

        Source: SNARF Eq. 9.
        """
        start = time.perf_counter()
        found = self.deformer(points, bone_transforms)
        after_search = time.perf_counter()
        logits = self.canonical_logits(found.canonical, self.condition(pose), found.pose, precision)
        blended = self.training
        combined = blend(logits, found, self.config.model) if blended else found.maximum(logits, NO_CORRESPONDENCE)
        done = time.perf_counter()
        return FieldSamples(combined, found.found, len(found.query), after_search - start, done - after_search)

    @torch.no_grad()
    def occupied_cells(
        self, pose: Tensor, threshold: float = 0.0, reach_m: float = 0.0, precision: str = "highest"
    ) -> Tensor:
        """Return which cells the canonical shape touches in any of several poses, bool [D-1, H-1, W-1].

        The shape is looked at where cells are active: elsewhere the network was never trained.

        Args:
            pose: [P, J, 3] axis-angle, radians.
            threshold: logit above which a sample counts as occupied; samples lie 4 cm apart or closer.
            reach_m: cells this near to an occupied sample, along each axis, are returned too, active or not.
            precision: of the shape network.
        """
        deformer = self.deformer
        deformer.remember_weights()
        size = deformer.grid.cell_size(deformer.shape)
        finer = (size / _SAMPLES_M).ceil().long()
        reach = (reach_m * finer / size - 1e-3).ceil().long().clamp_min(0).tolist()[::-1]
        finer = finer.tolist()[::-1]
        fine = deformer.active_cells
        for axis, factor in enumerate(finer):
            fine = fine.repeat_interleave(factor, axis)
        left = corners_of(fine).reshape(-1).nonzero()[:, 0]  # samples that were not occupied in any pose so far
        shape = [n + 1 for n in fine.shape]
        places = deformer.grid.nodes(shape).reshape(-1, 3)
        touched = torch.zeros(shape, dtype=torch.bool, device=places.device)
        for condition in self.condition(pose):
            values = self.canonical_logits(places[left], condition[None], torch.zeros_like(left), precision)
            touched.view(-1)[left[values > threshold]] = True
            left = left[values <= threshold]
        near = touched[None, None].float()
        for axis, count in enumerate(reach):
            along = [count if axis == other else 0 for other in range(3)]
            near = F.max_pool3d(near, [2 * n + 1 for n in along], 1, along)
        return F.max_pool3d(near, [factor + 1 for factor in finer], finer)[0, 0] > 0

    def refresh_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Search from now on where the learned shape is, or could soon be; for training, every now and then.

        These are all cells within 6 cm of what is occupied, or nearly, in any of the poses [P, J, 3]; so the shape can grow in
        every direction, beyond the first region too. Cells at the bones always stay. Nothing changes if every cell is to be
        searched (skinning.bone_radius_m is null), or while nothing is occupied.
        """
        cells = self.occupied_cells(pose, _GROWTH_LOGIT, _GROWTH_M, precision)
        if self._kept_cells is not None and bool(cells.any()):
            self.deformer.set_active_cells(cells | self._kept_cells)

    def tighten_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Keep only the cells within 4 cm of what the learned shape might occupy in any of the poses [P, J, 3].

        For a trained model: whatever is left out is empty in these poses, and what was never searched stays out. Nothing
        changes if every cell is to be searched (skinning.bone_radius_m is null), or if nothing is occupied.
        """
        cells = self.occupied_cells(pose, _FINAL_LOGIT, _FINAL_M, precision) & self.deformer.active_cells
        if self._kept_cells is not None and bool(cells.any()):
            self.deformer.set_active_cells(cells)

    def canonical_logits(self, canonical: Tensor, condition: Tensor, pose: Tensor, precision: str = "highest") -> Tensor:
        """Return the canonical occupancy logits [M] of points [M, 3] under `condition[pose]` ([B, C] and [M])."""
        with network_precision(precision, canonical.device):
            if torch.is_grad_enabled():
                extra = -len(canonical) % _ROUND_NUMBER if canonical.device.type == "cpu" else 0
                points = F.pad(canonical, (0, 0, 0, extra))
                padded = self.shape(points, condition, F.pad(pose, (0, extra)), self.seen_joints(points))
                return padded[: len(canonical)].to(canonical.dtype)
            chunks = zip(canonical.split(_POINTS_AT_ONCE), pose.split(_POINTS_AT_ONCE), strict=True)
            logits = [self.shape(points, condition, index, self.seen_joints(points)) for points, index in chunks]
            return torch.cat(logits).to(canonical.dtype)

    @torch.no_grad()
    def seen_joints(self, canonical: Tensor) -> Tensor | None:
        """Return how much canonical points [M, 3] see of each joint but the root, [M, J - 1], 0 to 1; None: all of each.

        A point sees the joints that bound the bones which move it. No gradient reaches the weights this way: that the shape
        could be mended by seeing other joints is no reason for a point to follow other bones.

        Source: after SCANimate (Saito et al., CVPR 2021), which masks the pose by skinning weights.
        """
        if self.config.condition.name != "local":
            return None
        return self.deformer.recent_weights(canonical) @ self._joints_of_bones


def blend(logits: Tensor, found: Correspondences, config: ModelConfig) -> Tensor:
    """Blend logits [M] over each query's correspondences to [B, N], smoothly, so that all of them get a gradient.

    The weights are a softmax over the real roots only, so that the result does not depend on how the roots were found.
    A query without a root gets `NO_CORRESPONDENCE`.

    Source: SNARF Sec. 3.2 (after Eq. 9); the form on logits is ours, and keeps its gradient where occupancies saturate.
    """
    values = logits if config.blend == "logit" else logits.sigmoid()
    scores = config.blend_sharpness * values
    total = found.batch * found.count
    highest = found.maximum(scores.detach(), 0.0).reshape(-1)
    weights = (scores - highest[found.query]).exp()
    zeros = logits.new_zeros(total)
    norm = zeros.index_add(0, found.query, weights)
    mean = zeros.index_add(0, found.query, weights * values) / norm.clamp_min(1e-12)
    mask = found.found.reshape(-1)
    if config.blend == "probability":
        mean = torch.logit(mean, eps=1e-6)
    return torch.where(mask, mean, NO_CORRESPONDENCE).reshape(found.batch, found.count)
