"""An avatar without a network: two capsules end to end, bent by a smooth skin at the joint between them."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.meshing.skinned import SkinnedSurface

RADIUS = 0.1
LENGTH = 0.5


def capsule(points: Tensor, start: tuple, end: tuple, radius: float) -> Tensor:
    """Distance into a capsule, positive inside, metres."""
    start_t, end_t = points.new_tensor(start), points.new_tensor(end)
    along = end_t - start_t
    share = ((points - start_t) @ along / (along @ along)).clamp(0, 1)
    return radius - (points - start_t - share[:, None] * along).norm(dim=1)


class ToyAvatar:
    """Two bones along x that meet at the origin of bone 1; further joints, if any, sit at the tip and move nothing.

    The posed field is that of the nearest preimage by fixed-point iteration, which has one root for moderate bends.
    """

    has_skinning_weights = True
    device = torch.device("cpu")

    def __init__(self, num_joints: int = 2, radius: float = RADIUS) -> None:
        rest = torch.zeros(num_joints, 3)
        rest[1:, 0] = LENGTH
        rest[2:, 0] = 2 * LENGTH
        names = tuple(f"joint_{j}" for j in range(num_joints))
        parents = tuple([-1, 0] + [1] * (num_joints - 2))
        self.skeleton = Skeleton(names, parents, rest, torch.zeros(num_joints, 3))
        self.radius = radius
        self.queried = 0

    def bone_transforms(self, pose: Tensor, translation: Tensor | None = None) -> Tensor:
        return self.skeleton.posed_from_canonical(pose, translation)

    def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
        return 40 * capsule(points_c, (0.0, 0, 0), (2 * LENGTH, 0, 0), self.radius)

    def skinning_weights(self, points_c: Tensor) -> Tensor:
        weights = points_c.new_zeros(len(points_c), self.skeleton.num_joints)
        weights[:, 1] = ((points_c[:, 0] - LENGTH) / 0.1).sigmoid()
        weights[:, 0] = 1 - weights[:, 1]
        return weights

    def skin(self, points_c: Tensor, bone_transforms: Tensor) -> Tensor:
        blended = torch.einsum("nj,jrc->nrc", self.skinning_weights(points_c), bone_transforms[:, :3])
        return (blended[:, :, :3] @ points_c[:, :, None])[:, :, 0] + blended[:, :, 3]

    def query(self, points: Tensor, bone_transforms: Tensor, pose: Tensor) -> SimpleNamespace:
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
            logits = torch.where(error < 1e-4, self.canonical_logits(points_c, pose[0]), -1e9)
            best = logits if best is None else torch.maximum(best, logits)
        return SimpleNamespace(logits=best[None], found=best[None] > -1e8, timings={})

    def canonical_box(self) -> tuple[Tensor, Tensor]:
        return torch.tensor([-0.2, -0.2, -0.2]), torch.tensor([2 * LENGTH + 0.2, 0.2, 0.2])

    def posed_box(self, bone_transforms: Tensor) -> tuple[Tensor, Tensor]:
        tips = torch.tensor([[0.0, 0, 0], [LENGTH, 0, 0], [2 * LENGTH, 0, 0]])
        moved = self.skin(tips, bone_transforms)
        return moved.amin(0) - 0.2, moved.amax(0) + 0.2

    def skinned_surface(self, resolution: int = 256, keep_share: float = 0.01) -> SkinnedSurface:
        return SkinnedSurface(self, resolution, keep_share=keep_share)
