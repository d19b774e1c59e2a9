"""Bodies far from the origin: a search runs near it, where float32 has the digits that a root needs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.roots import is_costly_to_read

__all__ = ["Centred", "centre"]

_NEAR = 4.0  # longest sides of the grid: up to here float32 loses no root of a complete search


@dataclass(frozen=True)
class Centred:
    """Poses and a grid of which those that are far from the origin have been moved there; the others are as they were."""

    transforms: Tensor
    """[B, J, 4, 4], from the moved canonical frame to the moved posed frames, metres."""
    grid: CanonicalGrid
    """Box in the moved canonical frame."""
    posed_origin: Tensor | None
    """[B, 3], origin of each moved posed frame in the given one, metres; None if all is near."""
    canonical_origin: Tensor | None
    """[3], origin of the moved canonical frame in the given one, metres; None if all is near."""

    def points(self, posed: Tensor) -> Tensor:
        """Return posed points [B, N, 3] in the moved frames."""
        return posed if self.posed_origin is None else posed - self.posed_origin[:, None]

    def starts(self, canonical: Tensor) -> Tensor:
        """Return canonical points [..., 3] in the moved frame."""
        return canonical if self.canonical_origin is None else canonical - self.canonical_origin

    def restored(self, canonical: Tensor, is_root: Tensor | None = None) -> Tensor:
        """Return canonical points [M, 3] of the moved frame in the given one.

        Args:
            canonical: [M, 3], metres.
            is_root: [M], bool; other rows are left as they are. None for all.
        """
        if self.canonical_origin is None:
            return canonical
        moved = canonical + self.canonical_origin
        return moved if is_root is None else torch.where(is_root[:, None], moved, canonical)


def centre(bone_transforms: Tensor, grid: CanonicalGrid) -> Centred:
    """Move poses and grid to the origin where a coordinate is larger than four of the grid's longest sides.

    With p' = p - o and x' = x - c the map p = T(x) x has the same form, since the weights sum to 1: only the translations
    change, t_j' = t_j + R_j c - o. The gradients of roots are unchanged, except that those to weights lack a part that is equal
    for all bones of a node. Nothing in it waits for a GPU.

    Args:
        bone_transforms: [B, J, 4, 4], canonical to posed, metres; J at least 1.
        grid: canonical box, of the same dtype and device.
    """
    with torch.no_grad():
        middle, reach = (grid.lower + grid.upper) / 2, _NEAR * (grid.upper - grid.lower).amax()
        images = (bone_transforms[..., :3, :3] * middle).sum(-1) + bone_transforms[..., :3, 3]
        if not is_costly_to_read(images) and not bool(_is_far(images, reach).any() | _is_far(middle, reach)):
            return Centred(bone_transforms, grid, None, None)
        images = images.sort(1).values[:, images.shape[1] // 2]  # the median, so that one stray bone does not count
        posed = torch.where(_is_far(images, reach)[:, None], images, 0.0)
        canonical = torch.where(_is_far(middle, reach), middle, 0.0)
    exact = torch.float64 if bone_transforms.device.type != "mps" else bone_transforms.dtype  # MPS has no float64
    turn, shift = bone_transforms[..., :3, :3], bone_transforms[..., :3, 3].to(exact)
    shift = shift + (turn.to(exact) * canonical.to(exact)).sum(-1) - posed.to(exact)[:, None]
    upper = torch.cat([turn, shift.to(turn.dtype)[..., None]], -1)
    moved_grid = CanonicalGrid(grid.lower - canonical, grid.upper - canonical, checked=True)
    return Centred(torch.cat([upper, bone_transforms[..., 3:, :]], -2), moved_grid, posed, canonical)


def _is_far(place: Tensor, reach: Tensor) -> Tensor:
    """Return whether a coordinate of places [..., 3] is larger than `reach` [], bool [...]; not if it is NaN."""
    return (place.abs() > reach).any(-1)
