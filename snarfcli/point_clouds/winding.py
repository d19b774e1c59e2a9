"""Winding numbers of oriented points: one half at the points of a closed surface whose normals point outward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["WindingProbes"]

Array = NDArray[np.float64]

_PROBES = 1200  # points at which winding numbers are measured
_SOURCES = 6000  # points that they are made from
_LEAST = 1e-100  # instead of 0 below a fraction


@dataclass(frozen=True, eq=False)
class WindingProbes:
    """Some points of a cloud, at which the winding number of the others is measured.

    Source: Barill et al., Fast Winding Numbers for Soups and Clouds, SIGGRAPH 2018, Eq. 7: each point is a dipole.
    """

    points: Array
    """[N, 3], all points."""
    areas: Array
    """[N], squared units, scaled by the share of the points that count as sources."""
    numbers: NDArray[np.intp]
    """[M], of the probes."""
    sources: NDArray[np.intp]
    """[S], of the points whose normals make the winding numbers."""

    @classmethod
    def of(cls, points: Array, areas: Array) -> WindingProbes:
        """Choose probes and sources by chance, always the same; areas [N] are those of the points [N, 3]."""
        order = np.random.default_rng(0).permutation(len(points))
        sources = order[:_SOURCES]
        share = areas[sources].sum() / max(areas.sum(), _LEAST)
        return cls(points, areas / max(share, _LEAST), order[:_PROBES], sources)

    def misfit(self, normals: Array) -> float:
        """Return how far the winding numbers of normals [N, 3] are from one half, from 0 to about 1 where all point inward."""
        numbers = self.by_group(normals, np.zeros(len(normals), np.intp))[:, 0]
        return float(np.square(numbers - 0.5).mean())

    def by_group(self, normals: Array, groups: NDArray[np.intp]) -> Array:
        """Return what each group of points adds to the winding numbers of the probes, [M, G].

        Args:
            normals: [N, 3], unit length.
            groups: [N], numbers from 0 on.
        """
        at, source = self.points[self.numbers], self.points[self.sources]
        middle = source.mean(axis=0)
        at, source = at - middle, source - middle
        weighted = normals[self.sources] * self.areas[self.sources, None]
        squared = np.square(at).sum(axis=1)[:, None] + np.square(source).sum(axis=1) - 2 * at @ source.T
        # A point alone stands for a disk, whose dipole is not infinite at its middle.
        squared = np.maximum(squared, 0.0) + self.areas[self.sources] / np.pi
        squared = np.maximum(squared, _LEAST)  # a point that occurs many times has no area
        solid = ((source * weighted).sum(axis=1) - at @ weighted.T) / (4 * np.pi * squared * np.sqrt(squared))
        added = np.zeros((groups.max() + 1, len(at)))
        np.add.at(added, groups[self.sources], solid.T)
        return added.T
