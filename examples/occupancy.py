"""Learn the shape and the skinning weights of an arm from occupied points of its poses, in an occupancy field of one's own.

This is SNARF in small: nothing is known of the arm but its two bones and, in some poses, which points are inside. It is
measured in poses that bend the elbow further than those that are learned. The arm is a capsule, so that the result can be
compared with it. Run it with `python examples/occupancy.py`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from snarf import CanonicalGrid, ForwardDeformer, SkinningConfig
from snarf.deformer import BonePrior

ELBOW, TIP, RADIUS = 0.5, 1.0, 0.1  # places along x and radius of the arm, metres
BONES = torch.tensor([[[0.0, 0, 0], [ELBOW, 0, 0]], [[ELBOW, 0, 0], [TIP, 0, 0]]])
GRID = CanonicalGrid(torch.tensor([-0.2, -0.2, -0.2]), torch.tensor([1.2, 0.2, 0.2]))
LEARNED, MEASURED = 0.7, 1.4  # largest bend of the elbow, radians
POSES, POINTS = 4, 1500  # per step
SHARPNESS = 20.0  # of the softmax over the roots


class Arm(nn.Module):
    """Occupancy of posed points: the canonical occupancy of their roots, united."""

    def __init__(self) -> None:
        super().__init__()
        settings = SkinningConfig(name="voxel", resolution=[29, 9, 9])
        near = BonePrior(BONES, [0, 1], num_bones=2, falloff=0.05)  # weights start from the distances to the bones
        self.deformer = ForwardDeformer(GRID, 2, settings, prior=near)
        layers = nn.Linear(3, 64), nn.Softplus(20), nn.Linear(64, 64), nn.Softplus(20), nn.Linear(64, 1)
        self.shape = nn.Sequential(*layers)

    def forward(self, points: Tensor, bone_transforms: Tensor) -> Tensor:
        """Return the probability [B, N] that posed points [B, N, 3] are inside."""
        found = self.deformer(points, bone_transforms)
        inside = self.shape(4 * found.canonical)[:, 0].sigmoid()
        return found.blend(inside, SHARPNESS, empty=0.0) if self.training else found.maximum(inside, empty=0.0)


class KnownArm:
    """The capsule, and the weights that bend it."""

    def __init__(self) -> None:
        settings = SkinningConfig(resolution=[57, 9, 9])
        self.deformer = ForwardDeformer(GRID, 2, settings, field=self.weights)

    @staticmethod
    def weights(x: Tensor) -> Tensor:
        """Return the weights [N, 2] at canonical points [N, 3]."""
        lower = ((x[:, 0] - ELBOW) / 0.04).sigmoid()
        return torch.stack([1 - lower, lower], 1)

    def __call__(self, points: Tensor, bone_transforms: Tensor) -> Tensor:
        """Return whether posed points [B, N, 3] are inside, [B, N] of 0 and 1."""
        found = self.deformer(points, bone_transforms)
        x = found.canonical
        nearest = torch.stack([x[:, 0].clamp(0, TIP), torch.zeros(len(x)), torch.zeros(len(x))], 1)
        return found.maximum((RADIUS - (x - nearest).norm(dim=1)), empty=-1.0).gt(0).float()


def bent(angles: Tensor) -> Tensor:
    """Return bone transforms [B, 2, 4, 4], canonical to posed: the second bone turns by angles [B] about z at the elbow."""
    transforms = torch.eye(4).repeat(len(angles), 2, 1, 1)
    cos, sin = angles.cos(), angles.sin()
    transforms[:, 1, 0, 0], transforms[:, 1, 0, 1], transforms[:, 1, 0, 3] = cos, -sin, ELBOW * (1 - cos)
    transforms[:, 1, 1, 0], transforms[:, 1, 1, 1], transforms[:, 1, 1, 3] = sin, cos, -ELBOW * sin
    return transforms


def points_near(transforms: Tensor) -> Tensor:
    """Return random points [B, POINTS, 3] within about 15 cm of the posed bones."""
    batch = len(transforms)
    bone = torch.randint(2, (batch, POINTS))
    share = torch.rand(batch, POINTS, 1)
    on_bone = torch.lerp(BONES[bone, 0], BONES[bone, 1], share)
    turned = transforms[torch.arange(batch)[:, None], bone]
    posed = (turned[..., :3, :3] * on_bone[:, :, None]).sum(-1) + turned[..., :3, 3]
    return posed + 0.08 * torch.randn(batch, POINTS, 3)


def iou(arm: Arm, known: KnownArm, angles: Tensor) -> float:
    """Return the intersection over union of the learned and the known arm near the bones, 0 to 1."""
    torch.manual_seed(1)
    transforms = bent(angles)
    points = points_near(transforms)
    with torch.no_grad():
        learned, true = arm.eval()(points, transforms) > 0.5, known(points, transforms) > 0.5
    arm.train()
    return float((learned & true).sum() / (learned | true).sum())


def train(steps: int, seed: int = 0) -> list[tuple[float, float]]:
    """Return the IoU in poses as learned, and in poses bent further, before training and after each quarter of it."""
    torch.manual_seed(seed)
    arm, known = Arm(), KnownArm()
    optimizer = torch.optim.Adam(arm.parameters(), lr=5e-3)
    angles = torch.linspace(-1, 1, 8)
    history = [(iou(arm, known, LEARNED * angles), iou(arm, known, MEASURED * angles))]
    for step in range(1, steps + 1):
        torch.manual_seed(seed + step)
        transforms = bent(LEARNED * (2 * torch.rand(POSES) - 1))
        points = points_near(transforms)
        inside = arm(points, transforms).clamp(1e-4, 1 - 1e-4)
        loss = F.binary_cross_entropy(inside, known(points, transforms)) + 0.01 * arm.deformer.smoothness()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % max(1, steps // 4) == 0:
            history.append((iou(arm, known, LEARNED * angles), iou(arm, known, MEASURED * angles)))
    return history


if __name__ == "__main__":
    for quarter, (learned, further) in enumerate(train(steps=300)):
        print(f"{25 * quarter:3} % of the steps: IoU {learned:.3f} in poses as learned, {further:.3f} bent further")
