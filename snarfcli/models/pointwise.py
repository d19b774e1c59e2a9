"""Systems without a search: they evaluate one canonical, or one posed, point for each posed point."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.bodies.extent import bone_segments
from snarfcli.deformer import CanonicalGrid, NodeWeights, inverse_skin
from snarfcli.models.settings import AvatarConfig
from snarfcli.models.system import FieldSamples, Found, System
from snarfcli.networks import WeightNormLinear
from snarfcli.precision import matmul_precision
from snarfcli.segments import distance_to_segments
from snarfcli.shape import OccupancyNetwork

__all__ = ["PointwiseSystem", "PosedNetwork", "every_point", "into_root_frame", "invert_blended", "move_with_bones"]

_LEAST_DETERMINANT = 0.01  # of blended rotations; that of neighbouring bones bent by 150 degrees is 0.07
_BOX_MARGIN_M = 0.06  # largest displacement of the surface by the pose beyond the training frames


@dataclass(frozen=True)
class FoundPoints(Found):
    """One canonical point for each of B x N posed points."""

    canonical: Tensor
    """[B, N, 3], metres."""
    weights: Tensor | None
    """Skinning weights [B, N, J] that led there, in systems that have them."""


class PointwiseSystem(System):
    """A system that evaluates exactly one point for each posed point.

    Args:
        config: architecture.
        skeleton: joint tree and canonical pose.
        grid: canonical box that holds the body.
        surface: [K, 3], rough points of the body, canonical, metres; their largest distance to the bones bounds the posed body.
        template: the subject's mesh, for systems that need it.
    """

    conditions: ClassVar[tuple[str, ...]] = ("global", "none")
    lower: Tensor
    upper: Tensor
    reach: Tensor
    _joints: Tensor

    def __init__(
        self,
        config: AvatarConfig,
        skeleton: Skeleton,
        grid: CanonicalGrid,
        surface: Tensor,
        template: MeshTemplate | None = None,
    ) -> None:
        bones = bone_segments(skeleton)
        super().__init__(config, skeleton)
        self.shape = self._make_shape(bones, (grid.lower, grid.upper))
        if isinstance(self.shape, OccupancyNetwork) and self.shape.grids is not None:
            self.shape.grids.cover()
        self.register_buffer("lower", grid.lower.clone())
        self.register_buffer("upper", grid.upper.clone())
        self.register_buffer("reach", distance_to_segments(surface, bones).max() + _BOX_MARGIN_M)
        self.register_buffer("_joints", skeleton.canonical_joints.clone(), persistent=False)
        self._build(skeleton, grid, template)

    def _build(self, skeleton: Skeleton, grid: CanonicalGrid, template: MeshTemplate | None) -> None:
        """Build the parts of the system besides its shape; the arguments are those of the constructor."""

    def find(
        self,
        points: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        weights: NodeWeights | None = None,
        capacity: int | None = None,
    ) -> Found:
        with matmul_precision("highest"), torch.autocast(points.device.type, enabled=False):
            return FoundPoints(*self.canonical_points(points, bone_transforms, pose))

    def shape_at(self, found: FoundPoints, pose: Tensor, precision: str = "highest") -> FieldSamples:
        batch, count = found.canonical.shape[:2]
        index = torch.arange(batch, device=found.canonical.device).repeat_interleave(count)
        weights = None if found.weights is None else found.weights.flatten(0, 1)
        logits = self.canonical_logits(found.canonical.flatten(0, 1), self.condition(pose), index, precision, weights)
        return every_point(logits.reshape(batch, count))

    def canonical_points(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the canonical points [B, N, 3] of posed points [B, N, 3], and the skinning weights [B, N, J] used, if any."""
        raise NotImplementedError

    @property
    def grid(self) -> CanonicalGrid:
        return CanonicalGrid(self.lower, self.upper, checked=True)

    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        """Return the box around the posed joints, widened by the largest distance of the body from its bones."""
        every = torch.arange(self.num_bones, device=self._joints.device)
        joints = move_with_bones(self._joints, every, bone_transforms[None])[0]
        return (joints.amin(0) - self.reach).cpu(), (joints.amax(0) + self.reach).cpu()


class PosedNetwork(nn.Module):
    """A network of a posed point and the pose, of the size of the skinning network.

    The pose is concatenated to the point at the input. Its part of the first layer is the same for all points of a pose, so it
    is evaluated once.

    Args:
        pose_size: length of the pose.
        outputs: number of outputs per point.
        config: width, depth and weight norm of the layers, from `skinning`.
        scale: lengths are divided by it, metres.
        starts_at_zero: whether the output is almost zero before training.
    """

    scale: Tensor

    def __init__(self, pose_size: int, outputs: int, config: AvatarConfig, scale: float, starts_at_zero: bool) -> None:
        super().__init__()
        sizes = [3 + pose_size] + [config.skinning.width] * config.skinning.depth + [outputs]
        layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
        if starts_at_zero:
            nn.init.normal_(layers[-1].weight, 0, 1e-4)
            nn.init.zeros_(layers[-1].bias)
        if config.skinning.weight_norm:
            layers = [WeightNormLinear(layer) for layer in layers]
            if starts_at_zero:  # small by its length alone: the first step would turn a short direction to anywhere
                with torch.no_grad():
                    layers[-1].direction.mul_(1e4 / config.skinning.width**0.5)
        self.layers = nn.ModuleList(layers)
        self.register_buffer("scale", torch.tensor(float(scale)))

    def forward(self, points: Tensor, pose: Tensor) -> Tensor:
        """Return the outputs [B, N, K] at points [B, N, 3], metres, in poses [B, P]."""
        first = cast(nn.Linear, self.layers[0])
        weight = first.weight
        h = F.linear(points / self.scale, weight[:, :3]) + F.linear(pose, weight[:, 3:], first.bias)[:, None]
        for layer in self.layers[1:]:
            h = layer(F.softplus(h, beta=100))
        return h


def every_point(logits: Tensor) -> FieldSamples:
    """Return samples [B, N] in which each point has one correspondence."""
    counts = torch.ones_like(logits, dtype=torch.long)
    return FieldSamples(logits, counts > 0, counts)


def into_root_frame(points: Tensor, bone_transforms: Tensor) -> Tensor:
    """Move posed points [B, N, 3] rigidly back with the root bone, so that the position of the body need not be learned."""
    root = bone_transforms[:, 0]
    return (points - root[:, None, :3, 3]) @ root[:, :3, :3]  # a rotation's inverse is its transpose


def move_with_bones(points: Tensor, owner: Tensor, bone_transforms: Tensor) -> Tensor:
    """Move canonical points [M, 3] rigidly with the bones `owner` [M] into every pose [B, J, 4, 4]: [B, M, 3]."""
    moved = bone_transforms[:, owner]
    return (moved[..., :3, :3] @ points[:, :, None])[..., 0] + moved[..., :3, 3]


def invert_blended(points: Tensor, weights: Tensor, bone_transforms: Tensor) -> Tensor:
    """Move posed points [B, N, 3] back by linear blend skinning with given weights [B, N, J], see `inverse_skin`.

    Blends of opposite rotations have no inverse. Near them points go far away but stay finite.
    """
    return inverse_skin(points, weights, bone_transforms, _LEAST_DETERMINANT)
