"""A prior of skinning weights: by the distance to each bone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from snarfcli.segments import segment_distances

__all__ = ["BonePrior"]

_FAR_M = 100.0  # distance of a bone that is nowhere
_DISTANCES_AT_ONCE = 2**24  # those of 65,536 nodes to 256 segments


class BonePrior(nn.Module):
    """Logits of skinning weights that fall with the distance to each bone, computed from the skeleton alone.

    At a joint its bone and its parent's bone are equally near, as SNARF Sec. 3.3 wants them there.

    Args:
        segments: [S, 2, 3], ends of the bones' segments, canonical frame, metres.
        owner: S bone numbers, the bone of each segment; a bone without a segment has no weight anywhere.
        num_bones: J.
        falloff: distance over which a weight falls by a factor e, metres.
    """

    segments: Tensor
    owner: Tensor

    def __init__(self, segments: Tensor, owner: Sequence[int], num_bones: int, falloff: float) -> None:
        super().__init__()
        self.num_bones, self.falloff = num_bones, falloff
        self.register_buffer("segments", segments.clone())
        self.register_buffer("owner", torch.tensor(list(owner)))

    def forward(self, points: Tensor, segments: Tensor | None = None) -> Tensor:
        """Return logits [N, J] at points [N, 3], metres, of the canonical frame, or of the frame of `segments` [S, 2, 3]."""
        segments = self.segments if segments is None else segments
        if len(points) * len(segments) > _DISTANCES_AT_ONCE:
            return torch.cat([self(part, segments) for part in points.split(max(1, _DISTANCES_AT_ONCE // len(segments)))])
        distances = segment_distances(points, segments)
        owner = self.owner.expand(len(points), -1)
        start = distances.new_full((len(points), self.num_bones), _FAR_M)
        return start.scatter_reduce(1, owner, distances, "amin") / -self.falloff

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        super()._load_from_state_dict(state_dict, prefix, *arguments)
        if not bool(((self.owner >= 0) & (self.owner < self.num_bones)).all()):
            arguments[-1].append(f"{prefix}owner: wanted bones from 0 to {self.num_bones - 1}, got others")
