"""The points of one frame, in the form in which a body is fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.point_clouds import bone_normals
from snarfcli.registration.scan_border import find_border

__all__ = ["NORMALS_M", "ScanPoints", "with_normals"]

Array = NDArray[np.float64]

NORMALS_M = 0.08
"""Distance that counts as much as normals at 60 degrees to each other, in the search of closest points."""
_LEAST_BORDER = 0.01  # share of the points


@dataclass(frozen=True)
class ScanPoints:
    """Points on the surface of one frame, metres, y up."""

    points: Array
    """[P, 3], metres."""
    normals: Array
    """[P, 3], unit length, outward."""
    whole: ScanPoints | None = None
    """The scan that these points are a part of, if it has more."""
    is_estimated: bool = False
    """Whether the normals are estimated by the points alone, so that some may point inward."""

    @classmethod
    def sampled(cls, points: Array, normals: Array, count: int, seed: int = 0, *, is_estimated: bool = False) -> ScanPoints:
        """Return at most `count` of the points, by chance; the same seed gives the same points."""
        order = np.random.default_rng(seed).permutation(len(points))[:count]
        points, normals = np.asarray(points, np.float64)[order], np.asarray(normals, np.float64)[order]
        return cls(points, normals, is_estimated=is_estimated)

    def __len__(self) -> int:
        return len(self.points)

    def first(self, count: int) -> ScanPoints:
        """Return the first of the points; they still know where the whole scan has its border."""
        whole = self if self.whole is None else self.whole
        return ScanPoints(self.points[:count], self.normals[:count], whole, self.is_estimated)

    def sided_by(self, joints: Array, parents: Sequence[int]) -> ScanPoints:
        """Return the points with normals that point away from the bones, if they are estimated; else unchanged.

        Args:
            joints: [J, 3], inside the surface, metres.
            parents: J parents, -1 for a root.
        """
        if not self.is_estimated:
            return self
        return ScanPoints(self.points, bone_normals(self.points, joints, parents), is_estimated=True)

    @cached_property
    def features(self) -> Array:
        """[P, 6], places and scaled normals."""
        return with_normals(self.points, self.normals)

    @cached_property
    def tree(self) -> KDTree:
        """Of the features."""
        return KDTree(self.features)

    @cached_property
    def border(self) -> KDTree | None:
        """Of the points at the border of the scan; None if its surface is closed, but for a few small holes."""
        if self.whole is not None:
            return self.whole.border
        found = find_border(self.points, self.normals)
        return KDTree(found) if len(found) > _LEAST_BORDER * len(self) else None

    @cached_property
    def centre(self) -> Array:
        """[3], middle of the box around the points, metres."""
        return (self.points.max(0) + self.points.min(0)) / 2


def with_normals(points: Array, normals: Array) -> Array:
    """Return places and scaled normals [N, 6] of points and normals [N, 3], between which closest points are searched."""
    return np.concatenate([points, NORMALS_M * normals], 1)
