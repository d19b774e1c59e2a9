"""An avatar that fails in some poses, for tests of the remaining frames."""

from __future__ import annotations

import os

from torch import Tensor
from toy_avatar import ToyAvatar


class FailingAvatar(ToyAvatar):
    """Bent by about 0.5 radians it has no surface; beyond 1.1 radians it ends its process, like the out-of-memory killer."""

    def query(self, points: Tensor, bone_transforms: Tensor, pose: Tensor):
        samples = super().query(points, bone_transforms, pose)
        bend = float(pose[0, 1, 2])
        if bend > 1.1:
            os._exit(9)
        if 0.45 < bend < 0.55:
            samples.logits = samples.logits * 0 - 1
        return samples
