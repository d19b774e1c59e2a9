"""The losses of SNARF Sec. 3.3."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.draws import Draws

__all__ = ["JOINT_TARGETS", "joint_weight_targets", "occupancy_loss", "points_on_bones"]

JOINT_TARGETS = ("halves", "parent", "own")
"""Target weights at a joint, see `joint_weight_targets`."""


def occupancy_loss(logits: Tensor, occupied: Tensor, found: Tensor) -> Tensor:
    """Return the binary cross-entropy of the posed field, averaged over all points.

    A point without a correspondence adds nothing, as its prediction, outside, does not depend on the shape. The training loop
    counts such points that are inside.

    Args:
        logits: [B, N].
        occupied: [B, N] bool, ground truth.
        found: [B, N] bool, which points have a correspondence.

    Source: SNARF Sec. 3.3.
    """
    entropy = F.binary_cross_entropy_with_logits(logits, occupied.to(logits), reduction="none")
    return torch.where(found, entropy, 0.0).sum() / max(logits.numel(), 1)


def points_on_bones(bones: Tensor, count: int, draws: Draws) -> Tensor:
    """Return `count` random points on each bone [S, 2, 3], [S * count, 3], canonical frame, metres (SNARF Sec. 3.3)."""
    share = draws.uniform(len(bones), count, 1).to(bones)
    return (bones[:, :1] + share * (bones[:, 1:] - bones[:, :1])).reshape(-1, 3)


def joint_weight_targets(parents: Sequence[int], target: str) -> Tensor:
    """Return the target skinning weights at the joints, [J, J], rows sum to 1.

    Args:
        parents: [J], parent of each joint, -1 for the root.
        target: "halves" for a half on each of the bones that meet at the joint (SNARF Sec. 3.3), "parent" for the bone of the
            parent (Fast-SNARF Sec. 3) or "own" for the joint's own bone (the released code). The root always has its own bone.

    Raises:
        ValueError: unknown `target`.
    """
    if target not in JOINT_TARGETS:
        raise ValueError(f"training.joint_target: wanted one of {', '.join(JOINT_TARGETS)}, got {target!r}")
    own_share = {"halves": 0.5, "parent": 0.0, "own": 1.0}[target]
    wanted = torch.zeros(len(parents), len(parents))
    for joint, parent in enumerate(parents):
        if parent < 0:
            wanted[joint, joint] = 1.0
        else:
            wanted[joint, joint] = own_share
            wanted[joint, parent] = 1.0 - own_share
    return wanted
