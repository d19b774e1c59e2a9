"""A chain of bones with a pose-dependent shape and smooth skinning weights, without a network."""

from __future__ import annotations

import numpy as np
import torch
from analytic_avatar import AnalyticAvatar, capsule
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid
from snarfcli.export.clips import Clip
from snarfcli.motions import Motion

JOINTS = 6
BONE = 0.2
RADIUS = 0.06
BULGE = 0.015
FRAME_RATE = 24.0


class ToyCharacter(AnalyticAvatar):
    """Six bones in a row along x, 20 cm each, bent in the canonical pose too; it swells where it bends."""

    def __init__(self, *, bulge: float = BULGE, spread: float = 0.12) -> None:
        rest = torch.zeros(JOINTS, 3)
        rest[:, 0] = BONE * torch.arange(JOINTS)
        canonical = torch.zeros(JOINTS, 3)
        canonical[0] = torch.tensor([0.0, 0.0, 0.3])
        canonical[2, 1] = 0.2
        skeleton = Skeleton(tuple(f"bone_{j}" for j in range(JOINTS)), tuple(range(-1, JOINTS - 1)), rest, canonical)
        joints = skeleton.canonical_joints
        grid = CanonicalGrid(joints.amin(0) - 0.15, joints.amax(0) + BONE + 0.15)
        super().__init__(skeleton, grid, subject="worm")
        self.bulge, self.spread = bulge, spread

    def canonical_logits(self, points_c: Tensor, pose: Tensor) -> Tensor:
        joints = self.skeleton.canonical_joints
        ends = [*joints[1:], joints[-1] + (joints[-1] - joints[-2])]
        inside = torch.stack([capsule(points_c, tuple(a), tuple(b), RADIUS) for a, b in zip(joints, ends, strict=True)])
        distance = inside.amax(0)
        for joint in range(1, JOINTS):
            near = torch.exp(-((points_c - joints[joint]).norm(dim=1) ** 2) / 0.1**2)
            distance = distance + self.bulge * torch.sin(pose[joint].sum()) * near
        return 40 * distance

    def skinning_weights(self, points_c: Tensor) -> Tensor:
        joints = self.skeleton.canonical_joints
        middles = (joints + torch.cat([joints[1:], joints[-1:] + joints[-1:] - joints[-2:-1]])) / 2
        distance = (points_c[:, None] - middles).norm(dim=2)
        return torch.softmax(-(distance**2) / (2 * self.spread**2), dim=1)


def wave(frames: int = 13, name: str = "wave", turn: float = 0.7, rate: float = FRAME_RATE) -> Motion:
    """Return a wave through the chain, which turns and travels; the last joint does not move."""
    time = np.arange(frames) / rate
    poses = np.zeros((frames, JOINTS, 3))
    poses[:, 0, 1] = 2.9 * np.sin(2 * time)
    for joint in range(1, JOINTS - 1):
        poses[:, joint, 2] = turn * np.sin(6 * time - joint)
        poses[:, joint, 1] = 0.4 * turn * np.cos(5 * time + joint)
    translation = np.stack([time, 1 + 0.1 * np.sin(9 * time), -0.5 * time], axis=1)
    return Motion(name, poses, translation, rate)


def stretched(motion: Motion, character: ToyCharacter, scale: float = 1.0) -> Clip:
    """Return a clip in which the bones from the fourth on drift away over time and grow by `scale`."""
    poses, translation = torch.from_numpy(motion.poses), torch.from_numpy(motion.translation)
    transforms = character.skeleton.to(torch.float64).posed_from_canonical(poses, translation).numpy().copy()
    share = np.linspace(0, 1, len(transforms))
    joints = character.skeleton.canonical_joints.double().numpy()
    for joint in range(3, JOINTS):
        size = 1 + (scale - 1) * share
        transforms[:, joint, :3, 3] += transforms[:, joint, :3, :3] @ joints[joint] * (1 - size[:, None])
        transforms[:, joint, :3, :3] *= size[:, None, None]
        transforms[:, joint, :3, 3] += 0.08 * share[:, None] * transforms[:, 3, :3, 0]
    return Clip(motion, transforms)
