"""Closest points of a scan from a grid: one look-up per query, for millions of queries."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from snarfcli.registration.scan_points import ScanPoints

__all__ = ["ScanGrid"]

Array = NDArray[np.float64]

_CELL_M = 0.03
_MARGIN_M = 0.3  # around the scan; queries outside are answered for the closest cell
_MOST_CELLS = 200  # per axis; the cells of a larger scan are larger


class ScanGrid:
    """A grid of cells that know a point of the scan about as close as the closest one."""

    def __init__(self, scan: ScanPoints) -> None:
        self.scan = scan
        lowest, highest = scan.points.min(0) - _MARGIN_M, scan.points.max(0) + _MARGIN_M
        self._cell = max(_CELL_M, float((highest - lowest).max()) / _MOST_CELLS)
        self._origin = lowest
        self._shape = np.ceil((highest - lowest) / self._cell).astype(np.intp) + 1
        occupied = np.full(self._shape, -1, np.intp)
        occupied[tuple(self._cells(scan.points).T)] = np.arange(len(scan))
        nearest = np.asarray(distance_transform_edt(occupied < 0, return_distances=False, return_indices=True))
        self._point = occupied[tuple(nearest)].reshape(-1)

    def closest(self, points: Array) -> NDArray[np.intp]:
        """Return the number of a close point of the scan for each of the points [..., 3]."""
        cells = self._cells(points)
        return self._point[(cells[..., 0] * self._shape[1] + cells[..., 1]) * self._shape[2] + cells[..., 2]]

    def _cells(self, points: Array) -> NDArray[np.intp]:
        return np.clip((points - self._origin) / self._cell, 0, self._shape - 1).astype(np.intp)
