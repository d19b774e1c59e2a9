"""Random poses beyond the training frames, for the loss that keeps the shape from floating in them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.draws import Draws

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

    def draw(self, count: int, draws: Draws) -> Tensor:
        """Return `count` poses, [count, J, 3], axis-angle, radians.

        Args:
            count: number of poses.
            draws: random numbers, on the device of the poses.
        """
        frames, joints, _ = self._poses.shape
        frame = draws.integers(frames, count, joints)
        reach = _FARTHEST * draws.uniform(count, joints, 1)
        axis = F.normalize(draws.normal(count, joints, 3), dim=-1)
        turn = _LARGEST_TURN_RAD * draws.uniform(count, joints, 1).square()
        turns = draws.uniform(count, joints, 1) < 0.5
        seen = self._poses[frame, torch.arange(joints, device=self._poses.device)]
        return self._mean + reach.to(seen) * (seen - self._mean) + (axis * turn * turns).to(seen)
