"""Random poses beyond the training frames, for the loss that keeps the shape from floating in them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["MadeUpPoses"]

_FARTHEST = 2.0  # from the mean pose, as a multiple of a joint's difference from it in a training pose
_LARGEST_TURN_RAD = 1.5  # added to half of the joints; most turns are small


class MadeUpPoses:
    """Random poses around those of the training frames and beyond.

    Every joint takes its rotation from another training frame, closer to its mean or up to twice as far from it, and half of
    the joints turn further about any axis. No limits of joints are needed: what is learned from these poses also holds in
    impossible ones.

    Args:
        poses: [F, J, 3], of the training frames, axis-angle, radians.
    """

    def __init__(self, poses: Tensor) -> None:
        self._poses, self._mean = poses, poses.mean(0)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return `count` poses, [count, J, 3], axis-angle, radians.

        Args:
            count: number of poses.
            generator: of random numbers, on the CPU.
        """
        frames, joints, _ = self._poses.shape
        frame = torch.randint(frames, (count, joints), generator=generator)
        reach = _FARTHEST * torch.rand(count, joints, 1, generator=generator)
        axis = F.normalize(torch.randn(count, joints, 3, generator=generator), dim=-1)
        turn = _LARGEST_TURN_RAD * torch.rand(count, joints, 1, generator=generator).square()
        turns = torch.rand(count, joints, 1, generator=generator) < 0.5
        seen = self._poses[frame.to(self._poses.device), torch.arange(joints, device=self._poses.device)]
        return self._mean + reach.to(seen) * (seen - self._mean) + (axis * turn * turns).to(seen)
