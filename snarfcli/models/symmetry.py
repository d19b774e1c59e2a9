"""The mirror symmetry of a skeleton."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.deformer import CanonicalGrid

__all__ = ["Mirror", "find_mirror"]

_TOLERANCE = 0.02  # largest distance of a joint from the mirror image of its counterpart, as a share of the skeleton's extent


@dataclass(frozen=True)
class Mirror:
    """A plane x = constant that maps a skeleton to itself."""

    bones: tuple[int, ...]
    """[J], the bone to which each is mapped."""
    plane: float
    """x of the plane, canonical frame, metres."""

    def complete(self, points: Tensor) -> Tensor:
        """Return points [K, 3] and their images, [2 K, 3], canonical frame, metres; a box around them is mapped to itself."""
        images = points * points.new_tensor([-1, 1, 1]) + points.new_tensor([2 * self.plane, 0, 0])
        return torch.cat([points, images])

    def maps_to_itself(self, grid: CanonicalGrid) -> bool:
        """Return whether a box is mapped to itself, up to a thousandth of its longest side."""
        return abs(float(grid.lower[0] + grid.upper[0]) / 2 - self.plane) <= 1e-3 * grid.longest_side


def find_mirror(skeleton: Skeleton) -> Mirror | None:
    """Return the mirror symmetry of a skeleton in the canonical pose; None if it has none, or no names of left and right."""
    bones = skeleton.left_right
    if bones == tuple(range(len(bones))):
        return None
    joints = skeleton.canonical_joints.double()
    images = joints[list(bones)]
    plane = float((joints[:, 0] + images[:, 0]).mean() / 2)
    images = images * joints.new_tensor([-1, 1, 1]) + joints.new_tensor([2 * plane, 0, 0])
    extent = float((joints.amax(0) - joints.amin(0)).max())
    parents = [skeleton.parents[bone] for bone in bones]
    same_tree = all((bones[p] if p >= 0 else -1) == q for p, q in zip(skeleton.parents, parents, strict=True))
    near = float((images - joints).norm(dim=1).max()) <= _TOLERANCE * extent
    return Mirror(bones, plane) if near and same_tree else None
