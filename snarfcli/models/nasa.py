"""NASA: one occupancy network per bone, in the bone's frame, and their union (Deng et al., ECCV 2020; SNARF Sec. 4.2)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarfcli.bodies import MeshTemplate, Skeleton
from snarfcli.bodies.extent import weight_segments
from snarfcli.bodies.kinematics import invert_rigid
from snarfcli.deformer import CanonicalGrid, NodeWeights
from snarfcli.deformer.skinning import skin
from snarfcli.draws import Draws
from snarfcli.models.pointwise import PointwiseSystem, every_point, move_with_bones
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.models.system import FieldSamples, Found
from snarfcli.precision import network_precision
from snarfcli.segments import distance_to_segments
from snarfcli.shape.network import LOGITS_PER_METRE

__all__ = ["Nasa", "PartNetworks"]

_LEAK = 0.1  # slope of the leaky ReLU for negative values (Deng et al.)
_ON_SURFACE = 0.5  # target occupancy of a part at its surface points (Deng et al.)
_POINTS_AT_ONCE = {"cpu": 1024, "cuda": 65_536}  # each is evaluated for every part; on a CPU small calls stay in the cache
# Lengths are divided by these before they enter a network. Points: half the length of a part; the surface IoU after 300 quick
# steps was 63 % with this, 56 % with 0.5 m. Root joint in a bone's frame: its typical distance.
_UNIT_M = 0.15
_ROOT_UNIT_M = 0.5


@dataclass(frozen=True)
class BoneFrames(Found):
    """The frames of the bones in B poses, in which the parts see the posed points."""

    points: Tensor
    """[B, N, 3], posed, metres."""
    local_from_posed: Tensor
    """Takes posed points into the frame of each bone, [B, J, 3, 4], metres."""
    root: Tensor
    """The root joint in the frame of each bone, [B, J, 3], metres."""


class Nasa(PointwiseSystem):
    """Parts that move rigidly with their bones and change their shape with the pose.

    The input of a part is a point in the frame of its bone and a code of a few numbers. The code is computed for each part from
    the pose, which is given as the position of the root joint in the frames of all bones. The union of the parts is their
    maximum. A loss assigns each surface point to the part with the largest ground-truth skinning weight. The loss that fills
    the bones applies at their posed points. With `model.part_code=0` parts are rigid, which Deng et al. call NASA (R);
    otherwise they deform, NASA (D). The system "piecewise" always has rigid parts.

    Occupancies are learned by cross-entropy, as in all systems here; the paper uses squared errors. The canonical shape of the
    other systems corrects capsules around the bones (`shape.prior_radius_m`); here each part corrects those of its bone.

    Arguments: as `PointwiseSystem`.
    """

    needs_template: ClassVar[bool] = True
    has_canonical_shape: ClassVar[bool] = False
    shape: PartNetworks
    _segments: Tensor
    _vertices: Tensor | None
    _vertex_weights: Tensor | None

    def __init__(
        self,
        config: AvatarConfig,
        skeleton: Skeleton,
        grid: CanonicalGrid,
        surface: Tensor,
        template: MeshTemplate | None = None,
    ) -> None:
        if config.model.name == "piecewise":
            config = replace(config, model=replace(config.model, part_code=0))
        super().__init__(config, skeleton, grid, surface, template)

    def _build(self, skeleton: Skeleton, grid: CanonicalGrid, template: MeshTemplate | None) -> None:
        self.register_buffer("_segments", _own_segments(skeleton), persistent=False)
        chosen = None if template is None else template.surface_vertices()
        for name, values in (("_vertices", template and template.vertices), ("_vertex_weights", template and template.weights)):
            given = None if values is None else torch.tensor(values[chosen], dtype=torch.float32)
            self.register_buffer(name, given, persistent=False)

    def _make_shape(self, bones: Tensor, box: tuple[Tensor, Tensor]) -> PartNetworks:
        return PartNetworks(self.config.model, self.num_bones)

    def find(
        self,
        points: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        weights: NodeWeights | None = None,
        capacity: int | None = None,
    ) -> Found:
        return self._bone_frames(points, bone_transforms)

    def shape_at(self, found: BoneFrames, pose: Tensor, precision: str = "highest") -> FieldSamples:
        return every_point(self._part_logits(found, precision).amax(1))

    def part_logits(self, points: Tensor, bone_transforms: Tensor, precision: str = "highest") -> Tensor:
        """Return the logits [B, J, N] of every part at posed points [B, N, 3]."""
        return self._part_logits(self._bone_frames(points, bone_transforms), precision)

    def _bone_frames(self, points: Tensor, bone_transforms: Tensor) -> BoneFrames:
        inverse = invert_rigid(bone_transforms)
        inverse = torch.cat([inverse[..., :3, :3], inverse[..., :3, 3:] - self._joints[:, :, None]], -1)
        root = bone_transforms[:, 0, :3, :3] @ self._joints[0] + bone_transforms[:, 0, :3, 3]
        local_root = (inverse[..., :3] @ root[:, None, :, None])[..., 0] + inverse[..., 3]
        return BoneFrames(points, inverse, local_root)

    def _part_logits(self, frames: BoneFrames, precision: str) -> Tensor:
        points, inverse = frames.points, frames.local_from_posed
        logits = []
        for part in points.split(max(1, _POINTS_AT_ONCE[points.device.type] // len(points)), 1):
            local = part[:, None] @ inverse[..., :3].transpose(-1, -2) + inverse[..., None, :, 3]
            with network_precision(precision, points.device):
                logits.append(self.shape(local / _UNIT_M, frames.root / _ROOT_UNIT_M).to(points.dtype))
            if self.config.shape.prior_radius_m is not None:
                logits[-1] = logits[-1] + self._capsules(local, self.config.shape.prior_radius_m)
        return torch.cat(logits, 2)

    @torch.no_grad()
    def _capsules(self, local: Tensor, radius_m: float) -> Tensor:
        """Return the logits [B, J, N] of the capsules around the segments of each part at points in its frame [B, J, N, 3]."""
        own = zip(local.unbind(1), self._segments, strict=True)
        distance = torch.stack([distance_to_segments(x.flatten(0, 1), segments).view(x.shape[:2]) for x, segments in own], 1)
        return LOGITS_PER_METRE * (radius_m - distance)

    def bone_logits(
        self,
        points: Tensor,
        owner: Tensor,
        bone_transforms: Tensor,
        pose: Tensor,
        precision: str = "highest",
        found: Found | None = None,
    ) -> Tensor:
        """Return logits at the posed points of the bones, [B, M], since there is no canonical shape."""
        return self(move_with_bones(points, owner, bone_transforms), bone_transforms, pose, precision).logits

    def extra_losses(
        self,
        bone_transforms: Tensor,
        pose: Tensor,
        draws: Draws,
        precision: str = "highest",
        found: Found | None = None,
    ) -> dict[str, Tensor]:
        """Return the loss that puts each surface point on the border of one part and outside all others.

        Source: Deng et al., the weight loss.
        """
        config = self.config.model
        if config.part_weight <= 0:
            return {}
        if self._vertices is None or self._vertex_weights is None:
            raise ValueError(f"template: wanted the subject's mesh to train {config.name}, got none")
        chosen = draws.integers(len(self._vertices), config.part_points)
        vertices, weights = self._vertices[chosen], self._vertex_weights[chosen]
        posed = skin(vertices, weights, bone_transforms)
        wanted = _ON_SURFACE * F.one_hot(weights.argmax(1), self.num_bones).T.to(weights)
        occupancy = self.part_logits(posed, bone_transforms, precision).sigmoid()
        return {"parts": config.part_weight * F.mse_loss(occupancy, wanted.expand_as(occupancy))}


def _own_segments(skeleton: Skeleton) -> Tensor:
    """Return the segments that move with each joint, relative to it, [J, S, 2, 3], metres; repeated up to S per joint."""
    segments, owner = weight_segments(skeleton)
    own = [[one for one, joint in zip(segments, owner, strict=True) if joint == bone] for bone in range(skeleton.num_joints)]
    most = max(len(some) for some in own)
    padded = torch.stack([torch.stack(some + [some[0]] * (most - len(some))) for some in own])
    return padded - skeleton.canonical_joints[:, None, None]


class PartNetworks(nn.Module):
    """Small networks of equal size, one per bone, evaluated together.

    Args:
        config: their size.
        num_bones: J.
    """

    def __init__(self, config: ModelConfig, num_bones: int) -> None:
        super().__init__()
        width, depth = config.part_width, config.part_depth
        if width < 1 or depth < 1 or config.part_code < 0:
            raise ValueError(
                "model.part_width, part_depth, part_code: wanted at least 1, 1 and 0, "
                f"got {width}, {depth} and {config.part_code}"
            )
        sizes = [3 + config.part_code] + [width] * depth + [1]
        shapes = list(itertools.pairwise(sizes))
        # as nn.Linear starts
        self.weights = nn.ParameterList(_uniform((num_bones, a, b), a) for a, b in shapes)
        self.biases = nn.ParameterList(_uniform((num_bones, 1, b), a) for a, b in shapes)
        self.reduce = nn.Parameter(_uniform((num_bones, 3 * num_bones, config.part_code), 3 * num_bones))

    def forward(self, local: Tensor, roots: Tensor) -> Tensor:
        """Return the logits [B, J, N] at points [B, J, N, 3] in the frames of the bones.

        Args:
            local: [B, J, N, 3], the points, in units of `_UNIT_M`.
            roots: [B, J, 3], the pose: the root joint in the frames of the bones, in units of `_ROOT_UNIT_M`.
        """
        batch, bones, count = local.shape[:3]
        code = torch.einsum("bp,jpc->bjc", roots.flatten(1), self.reduce)
        first = self.weights[0]
        # the pose's part of the first layer is the same for all points of a pose
        h = local @ first[:, :3] + (code[:, :, None] @ first[:, 3:] + self.biases[0])
        h = h.transpose(0, 1).reshape(bones, batch * count, -1)
        for weight, bias in zip(self.weights[1:], self.biases[1:], strict=True):
            h = torch.baddbmm(bias, F.leaky_relu(h, _LEAK), weight)
        return h.reshape(bones, batch, count).transpose(0, 1)


def _uniform(shape: tuple[int, ...], inputs: int) -> nn.Parameter:
    """Return a parameter distributed as the weights of `nn.Linear` with this number of inputs."""
    bound = 1 / math.sqrt(inputs)
    return nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
