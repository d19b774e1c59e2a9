"""How far two moving surfaces are apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Deviation"]

# Distances are counted in steps of a micrometre up to a metre: percentiles over all vertices and frames in 8 MB.
_STEP_M = 1e-6
_STEPS = 1_000_000


class Deviation:
    """Largest, mean square and 99th percentile of distances, over vertices and frames that come one after the other."""

    def __init__(self) -> None:
        self.max_mm = 0.0
        """Largest distance, millimetres."""
        self._squares, self._count = 0.0, 0
        self._steps = np.zeros(_STEPS + 1, dtype=np.int64)

    def add(self, difference: NDArray) -> None:
        """Take in the differences [V, 3] of one frame, metres."""
        distance = np.linalg.norm(difference.astype(np.float64), axis=1)
        self.max_mm = max(self.max_mm, 1000 * float(distance.max()))
        self._squares += float(distance @ distance)
        self._count += len(distance)
        self._steps += np.bincount((distance / _STEP_M).clip(0, _STEPS).astype(np.int64), minlength=_STEPS + 1)

    @property
    def rms_mm(self) -> float:
        """Root of the mean square, millimetres."""
        return 1000 * (self._squares / max(self._count, 1)) ** 0.5

    @property
    def p99_mm(self) -> float:
        """Distance that 99 of 100 are below, millimetres, to a micrometre."""
        wanted = np.searchsorted(np.cumsum(self._steps), 0.99 * self._count)
        return min(1000 * _STEP_M * (int(wanted) + 1), self.max_mm)

    def facts(self) -> dict[str, float]:
        """Return the three numbers for a record, millimetres to a micrometre."""
        return {name: round(getattr(self, name), 3) for name in ("max_mm", "p99_mm", "rms_mm")}
