"""An avatar without a network: two capsules end to end, bent by a smooth skin at the joint between them."""

from __future__ import annotations

import torch
from analytic_avatar import AnalyticAvatar, capsule
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.models.system import NO_CORRESPONDENCE, FieldSamples

RADIUS = 0.1
LENGTH = 0.5


class ToyAvatar(AnalyticAvatar):
    """Two bones along x that meet at the origin of bone 1; further joints, if any, sit at the tip and move nothing.

    The posed field is that of the nearest preimage by fixed-point iteration, which has one root for moderate bends.
    """

    def __init__(self, num_joints: int = 2, radius: float = RADIUS) -> None:
        rest = torch.zeros(num_joints, 3)
        rest[1:, 0] = LENGTH
        rest[2:, 0] = 2 * LENGTH
        names = tuple(f"joint_{j}" for j in range(num_joints))
        parents = tuple([-1, 0] + [1] * (num_joints - 2))
        skeleton = Skeleton(names, parents, rest, torch.zeros(num_joints, 3))
        super().__init__(skeleton, CanonicalGrid(torch.full((3,), -0.2), torch.tensor([2 * LENGTH + 0.2, 0.2, 0.2])))
        self.radius = radius
        self.queried = 0

    def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
        return 40 * capsule(points_c, (0.0, 0, 0), (2 * LENGTH, 0, 0), self.radius)

    def skinning_weights(self, points_c: Tensor) -> Tensor:
        weights = points_c.new_zeros(len(points_c), self.skeleton.num_joints)
        weights[:, 1] = ((points_c[:, 0] - LENGTH) / 0.1).sigmoid()
        weights[:, 0] = 1 - weights[:, 1]
        return weights

    def query(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> FieldSamples:
        points, transforms = points[0], bone_transforms[0]
        self.queried += len(points)
        best = None
        for bone in (0, 1):
            inverse = torch.linalg.inv(transforms[bone])
            points_c = points @ inverse[:3, :3].T + inverse[:3, 3]
            for _ in range(30):
                blended = torch.einsum("nj,jrc->nrc", self.skinning_weights(points_c), transforms[:, :3])
                points_c = torch.linalg.solve(blended[:, :, :3], (points - blended[:, :, 3])[:, :, None])[:, :, 0]
            error = (self.skin(points_c, transforms) - points).norm(dim=1)
            logits = torch.where(error < 1e-4, self.canonical_logits(points_c, pose[0]), NO_CORRESPONDENCE)
            best = logits if best is None else torch.maximum(best, logits)
        assert best is not None
        found = best[None] > NO_CORRESPONDENCE
        return FieldSamples(best[None], found, found.long())

    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        tips = torch.tensor([[0.0, 0, 0], [LENGTH, 0, 0], [2 * LENGTH, 0, 0]])
        moved = self.skin(tips, bone_transforms)
        return moved.amin(0) - 0.2, moved.amax(0) + 0.2
