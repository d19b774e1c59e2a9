"""Fast-SNARF: canonical occupancy moved by forward skinning on a weight grid (Fast-SNARF Sec. 3-4, SNARF Sec. 3)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.bodies.extent import bone_segments, weight_segments
from snarfcli.deformer import BonePrior, CanonicalGrid, Correspondences, ForwardDeformer, NodeWeights, SearchConfig, cells_near
from snarfcli.deformer.cells import corners_of
from snarfcli.deformer.skinning import skin
from snarfcli.deformer.weights import VoxelWeights
from snarfcli.draws import Draws
from snarfcli.models.occupied import OccupiedSamples, parts_of_cells, sample_cells
from snarfcli.models.pieces import floating_cells
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.models.symmetry import find_mirror
from snarfcli.models.system import NO_CORRESPONDENCE, FieldSamples, Found, System
from snarfcli.shape import OccupancyNetwork

__all__ = ["FastSnarf", "FoundRoots", "blend"]

_KEPT_RADIUS_M = 0.1  # cells with a corner at most this far from a bone are always searched
_GROWTH_M = 0.06  # margin of the cells searched in training around what might be occupied
_GROWTH_LOGIT = -3.0  # logit that counts as "might be occupied" in training: 5 %
_FINAL_M = 0.04
_FINAL_LOGIT = -2.0  # the same after training, for poses that were not sampled: 12 %
_SURE_LOGIT = 1.0  # from here on a label is taken from the shape itself: 73 %
_SURFACE_MOVES_M = 0.06  # largest displacement of the canonical surface by the pose


@dataclass(frozen=True)
class FoundRoots(Found):
    """All canonical points that forward skinning moves onto the posed points, and the weights of that skinning."""

    roots: Correspondences
    """The canonical points."""
    weights: NodeWeights | None
    """Skinning weights at the grid nodes; None for a field that was searched directly."""

    @property
    def total(self) -> Tensor:
        return self.roots.total


class FastSnarf(System):
    """Posed occupancy by correspondence search and a canonical occupancy network.

    The system "snarf" is Fast-SNARF without its grid: the field of `skinning` is a network, and its own roots are found. Its
    `skinning.name` is always "mlp", and its `search.name` must be "broyden".

    Args:
        config: architecture.
        skeleton: joint tree and canonical pose.
        grid: canonical box of the skinning weights.
        surface: [K, 3], rough points of the body, canonical, metres; with the bones they define the cells searched at first.
        template: not used.
        field: weight field to use instead of the one that `config.skinning` describes; needed for preset weights.
    """

    has_skinning_weights: ClassVar[bool] = True
    _kept_cells: Tensor | None
    _canonical_pose: Tensor

    def __init__(
        self,
        config: AvatarConfig,
        skeleton: Skeleton,
        grid: CanonicalGrid,
        surface: Tensor,
        template: MeshTemplate | None = None,
        field: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        if config.model.name == "snarf":
            config = replace(config, skinning=replace(config.skinning, name="mlp", smoothness=0.0))
        super().__init__(config, skeleton)
        if config.model.blend not in ("logit", "probability"):
            raise ValueError(f"model.blend: wanted logit or probability, got {config.model.blend!r}")
        width, height, depth = config.skinning.resolution
        parts_of_cells(grid, (depth, height, width))
        skinning, bones, num_bones = config.skinning, bone_segments(skeleton), skeleton.num_joints
        active = kept = prior = None
        if skinning.bone_radius_m is not None:
            points = surface[:, None].expand(-1, 2, -1)
            places = [(bones, skinning.bone_radius_m), (points, skinning.surface_radius_m)]
            active = cells_near(grid, (depth, height, width), places)
            kept = cells_near(grid, (depth, height, width), [(bones, min(skinning.bone_radius_m, _KEPT_RADIUS_M))])
        if skinning.prior_falloff_m is not None:
            prior = BonePrior(*weight_segments(skeleton, continued=True), num_bones, skinning.prior_falloff_m)
        mirror = find_mirror(skeleton) if skinning.symmetric else None
        if mirror is not None and not mirror.maps_to_itself(grid):
            raise ValueError(
                "skinning.symmetric: wanted a canonical box that is symmetric too, got another; see Mirror.complete"
            )
        self.deformer = ForwardDeformer(
            grid,
            num_bones,
            skinning,
            config.search,
            active,
            prior,
            parents=skeleton.parents,
            field=field,
            mirror=None if mirror is None else mirror.bones,
        )
        self.register_buffer("_kept_cells", kept, persistent=False)
        self.shape = self._make_shape(bones, (grid.lower, grid.upper))
        self._cover_features()
        self.register_buffer("_canonical_pose", skeleton.canonical_pose.float(), persistent=False)
        self._body_cells: Tensor | None = None

    def node_weights(self) -> NodeWeights | None:
        return self.deformer.node_weights()

    def find(
        self,
        points: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        weights: NodeWeights | None = None,
        capacity: int | None = None,
    ) -> FoundRoots:
        weights = self.node_weights() if weights is None else weights
        roots = self.deformer(points, bone_transforms, capacity, weights)
        return FoundRoots(roots if capacity is None else roots.unreported(), weights)

    def shape_at(self, found: FoundRoots, pose: Tensor, precision: str = "highest") -> FieldSamples:
        """Evaluate the shape network at the roots; a point gets their blend in training, and their maximum otherwise.

        Source: SNARF Eq. 9.
        """
        roots = found.roots
        weights = self._weights_seen(roots.canonical, found.weights)
        logits = self.canonical_logits(roots.canonical, self.condition(pose), roots.pose, precision, weights)
        combined = blend(logits, roots, self.config.model) if self.training else roots.maximum(logits, NO_CORRESPONDENCE)
        counts = roots.counts
        return FieldSamples(combined, counts > 0, counts)

    @torch.no_grad()
    def _weights_seen(self, canonical: Tensor, weights: NodeWeights | None) -> Tensor | None:
        """Return the skinning weights [M, J] at canonical points [M, 3] if the shape depends on them, else None."""
        return self.deformer.skinning_weights(canonical, weights) if self.depends_on_weights else None

    @torch.no_grad()
    def occupied_cells(self, pose: Tensor, threshold: float = 0.0, reach_m: float = 0.0, precision: str = "highest") -> Tensor:
        """Return whether cells touch the canonical shape in any of several poses, [D-1, H-1, W-1], bool.

        Only active cells are sampled: elsewhere the network was never trained.

        Args:
            pose: [P, J, 3], axis-angle, radians.
            threshold: logit above which a sample counts as occupied; samples lie at most 4 cm apart.
            reach_m: cells at most this far from an occupied sample, along each axis, are included, active or not.
            precision: of the shape network.
        """
        return self._occupied(pose, threshold, precision).touched_cells(reach_m)

    def extend_weights(self, pose: Tensor, precision: str = "highest") -> tuple[nn.Parameter, Tensor] | None:
        """Extend the skinning weights at nodes near the surface in the poses [P, J, 3] to all other nodes.

        Nodes of the cells at the surface and of their neighbours keep their weights. Nothing changes for a weight field that is
        not optimised at the nodes, or while nothing is occupied.
        """
        field = self.deformer.field
        if not isinstance(field, VoxelWeights):
            return None
        near = F.max_pool3d(self.surface_cells(pose, precision)[None, None].float(), 3, 1, 1)[0, 0] > 0
        if not bool(near.any()):
            return None
        return field.logits, field.extend_from(corners_of(near))

    @torch.no_grad()
    def surface_cells(self, pose: Tensor, precision: str = "highest") -> Tensor:
        """Return whether cells hold a part of the shape's surface, [D-1, H-1, W-1], bool.

        The shape is all that is occupied in any of the poses [P, J, 3]; cells are sampled as in `occupied_cells`.
        """
        return self._occupied(pose, 0.0, precision).surface_cells()

    def _occupied(self, pose: Tensor, threshold: float, precision: str) -> OccupiedSamples:
        """Return which samples of the active cells are occupied in any of the poses [P, J, 3]."""
        weights = self.deformer.node_weights(active_only=True)

        def logits_in(condition: Tensor, canonical: Tensor) -> Tensor:
            return self._logits_in(condition, canonical, self._weights_seen(canonical, weights), precision)

        return sample_cells(self.deformer, [partial(logits_in, condition) for condition in self.condition(pose)], threshold)

    def refresh_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Recompute the active cells from the current shape; called periodically in training.

        They are all cells within 6 cm of what might be occupied in any of the poses [P, J, 3], so that the shape can grow in
        every direction, also beyond the first region. Cells at the bones always stay active. Nothing changes if all cells are
        searched (skinning.bone_radius_m is null), in a search without cells, or while nothing is occupied.
        """
        if self.search.name != "complete":
            return
        cells = self.occupied_cells(pose, _GROWTH_LOGIT, _GROWTH_M, precision)
        if self._kept_cells is not None and bool(cells.any()):
            self.deformer.set_active_cells(cells | self._kept_cells)
            self._cover_features()

    def _cover_features(self) -> None:
        """Give features to the nodes of feature grids in active cells; to all if the search has no cells."""
        grids = self.shape.grids if isinstance(self.shape, OccupancyNetwork) else None
        if grids is not None:
            grids.cover(self.deformer.active_cells if self.search.name == "complete" else None)

    def tighten_cells(self, pose: Tensor, precision: str = "highest") -> None:
        """Keep only the active cells within 4 cm of what the final shape might occupy in any of the poses [P, J, 3].

        For a trained model: cells that are dropped are empty in these poses, and no cell is added. Nothing changes if all cells
        are searched (skinning.bone_radius_m is null), or if nothing is occupied.
        """
        cells = self.occupied_cells(pose, _FINAL_LOGIT, _FINAL_M, precision) & self.deformer.active_cells
        if self._kept_cells is not None and bool(cells.any()):
            self.deformer.set_active_cells(cells)

    @torch.no_grad()
    def drop_pieces(self, pose: Tensor, inside: Iterable[tuple[FoundRoots, Tensor]], precision: str = "highest") -> int:
        """Stop searching cells that hold nothing but pieces which do not belong to the subject (see `floating_cells`)."""
        if self.search.name != "complete":
            return 0
        occupied = self._occupied(pose, 0.0, precision)
        lower, upper = self.deformer.lower, self.deformer.upper
        places, query, first = [lower.new_empty(0, 3)], [torch.empty(0, dtype=torch.long, device=lower.device)], 0
        for found, posed in inside:
            roots = found.roots
            weights = self._weights_seen(roots.canonical, found.weights)
            logits = self.canonical_logits(roots.canonical, self.condition(posed), roots.pose, precision, weights)
            places.append(roots.canonical[logits > 0])
            query.append(first + roots.query[logits > 0])
            first += roots.batch * roots.count
        steps = lower.new_tensor([n - 1 for n in occupied.samples.shape[:1:-1]]) / (upper - lower)
        lattice = (torch.cat(places) - lower) * steps
        is_occupied, wanted = occupied.samples[0, 0] > 0, self.config.model.components
        cells, dropped = floating_cells(is_occupied, occupied.parts, lattice, torch.cat(query), wanted)
        left = self.deformer.active_cells & ~cells
        if not bool((cells & self.deformer.active_cells).any()) or not bool(left.any()):
            return 0
        self.deformer.set_active_cells(left)
        return dropped

    # ---------------------------------------------------------------- training
    @property
    def has_fixed_shapes(self) -> bool:
        return not self.deformer.searches_field

    def keep_room(self) -> None:
        self.deformer.keep_room()

    def bone_logits(
        self,
        points: Tensor,
        owner: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        precision: str = "highest",
        found: FoundRoots | None = None,
    ) -> Tensor:
        index = torch.arange(len(points), device=points.device) % len(pose)
        weights = self._weights_seen(points, None if found is None else found.weights)
        return self.canonical_logits(points, self.condition(pose), index, precision, weights)

    def joint_weights(self, joints: Tensor, bone_transforms: Tensor, pose: Tensor) -> Tensor | None:
        weights = self.deformer.field(joints)
        return weights if weights.requires_grad else None  # given weights are not trained

    def extra_losses(
        self,
        bone_transforms: Tensor,
        pose: Tensor,
        draws: Draws,
        precision: str = "highest",
        found: FoundRoots | None = None,
    ) -> dict[str, Tensor]:
        smoothness = self.config.skinning.smoothness
        if smoothness <= 0:
            return {}
        return {"smoothness": smoothness * self.deformer.smoothness(None if found is None else found.weights)}

    def agreement_loss(
        self,
        pose: Tensor,
        made_up: Tensor,
        count: int,
        draws: Draws,
        precision: str = "highest",
        found: FoundRoots | None = None,
        masks: bool = False,
    ) -> Tensor | None:
        """Return the cross-entropy at random canonical points in made-up poses, with labels from the training poses.

        A point is labelled where the shape says clearly, and equally in all training poses, whether it is occupied. Without
        this a shape that depends on the pose may put pieces far from the body in poses unlike the training poses.
        """
        if not self.shape.conditioned:
            return None
        canonical = self.deformer.random_canonical(count, draws)
        weights = self._weights_seen(canonical, None if found is None else found.weights)
        with torch.no_grad():
            known = torch.stack([self._logits_in(one, canonical, weights, precision) for one in self.condition(pose)])
            inside = known.amin(0) > _SURE_LOGIT
            is_sure = inside | (known.amax(0) < -_SURE_LOGIT)
        condition = self.condition(made_up)
        if masks:
            # the n-th of the sure points has the n-th pose, as below
            index = draws.integers(len(made_up), count)[(is_sure.cumsum(0) - 1).clamp_min(0)]
            logits = self.canonical_logits(canonical, condition, index, precision, weights)
            entropy = F.binary_cross_entropy_with_logits(logits, inside.to(logits), reduction="none")
            return torch.where(is_sure, entropy, 0.0).sum() / count
        sure = is_sure.nonzero()[:, 0]
        index = draws.integers(len(made_up), len(sure))
        seen = None if weights is None else weights[sure]
        logits = self.canonical_logits(canonical[sure], condition, index, precision, seen)
        return F.binary_cross_entropy_with_logits(logits, inside[sure].to(logits), reduction="sum") / count

    def _logits_in(self, condition: Tensor, canonical: Tensor, weights: Tensor | None, precision: str) -> Tensor:
        """Return the logits [M] of canonical points [M, 3] under one condition [C]."""
        one = torch.zeros(len(canonical), dtype=torch.long, device=canonical.device)
        return self.canonical_logits(canonical, condition[None], one, precision, weights)

    @torch.no_grad()
    def far_points(self, count: int, bone_transforms: Tensor, draws: Draws, weights: NodeWeights | None = None) -> Tensor:
        """Return random points of the searched cells, moved by the poses."""
        canonical = self.deformer.random_canonical(count, draws)
        # without `weights`, the field itself at the points: to interpolate it, it would be evaluated at every node
        chosen = self.deformer.field(canonical) if weights is None else weights.at(canonical)
        return skin(canonical, chosen, bone_transforms)

    def freeze(self) -> None:
        """Evaluate the skinning weights at the grid's nodes once and keep them.

        For weights that are searched directly (skinning.name "mlp") only `posed_box` uses the frozen grid.
        """
        self.eval()
        self.deformer.freeze()
        self._body_cells = None

    # ---------------------------------------------------------------- use
    @property
    def grid(self) -> CanonicalGrid:
        return self.deformer.grid

    @property
    def search(self) -> SearchConfig:
        return self.deformer.search

    def choose_search(self, search: SearchConfig) -> None:
        self.deformer.search = search

    def is_searched(self, canonical: Tensor) -> Tensor:
        return self.deformer.is_active(canonical)

    def skinning_weights(self, canonical: Tensor) -> Tensor:
        return self.deformer.skinning_weights(canonical)

    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return a box around the images of all cells within 6 cm of the shape in the canonical pose."""
        if self._body_cells is None:
            touched = self.occupied_cells(self._canonical_pose[None], reach_m=_SURFACE_MOVES_M)
            self._body_cells = touched if bool(touched.any()) else self.deformer.active_cells
        return self.deformer.posed_box(bone_transforms, self._body_cells)


def blend(logits: Tensor, found: Correspondences, config: ModelConfig) -> Tensor:
    """Blend logits [M] over the correspondences of each query to [B, N], so that each of them gets a gradient.

    A query without a root gets `NO_CORRESPONDENCE`. The papers blend probabilities; the form on logits is ours, and keeps its
    gradient where occupancies saturate.
    """
    if config.blend == "logit":
        return found.blend(logits, config.blend_sharpness, NO_CORRESPONDENCE)
    mean = found.blend(logits.sigmoid(), config.blend_sharpness, 0.0)
    return torch.where(found.found, torch.logit(mean, eps=1e-6), NO_CORRESPONDENCE)
