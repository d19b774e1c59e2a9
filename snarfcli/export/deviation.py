"""Statistics of the distance between two moving surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Deviation"]

# A histogram with steps of 1 micrometre up to 1 metre gives percentiles over all vertices and frames in 8 MB.
_STEP_M = 1e-6
_STEPS = 1_000_000


class Deviation:
    """Maximum, root mean square and 99th percentile of distances over vertices and frames, updated frame by frame."""

    def __init__(self) -> None:
        self.max_mm = 0.0
        """Maximum distance, millimetres."""
        self._squares, self._count = 0.0, 0
        self._steps = np.zeros(_STEPS + 1, dtype=np.int64)

    def add(self, difference: NDArray) -> None:
        """Add the differences [V, 3] of one frame, metres."""
        distance = np.linalg.norm(difference.astype(np.float64), axis=1)
        self.max_mm = max(self.max_mm, 1000 * float(distance.max()))
        self._squares += float(distance @ distance)
        self._count += len(distance)
        self._steps += np.bincount((distance / _STEP_M).clip(0, _STEPS).astype(np.int64), minlength=_STEPS + 1)

    @property
    def rms_mm(self) -> float:
        """Root mean square, millimetres."""
        return 1000 * (self._squares / max(self._count, 1)) ** 0.5

    @property
    def p99_mm(self) -> float:
        """99th percentile, millimetres, rounded up to a micrometre."""
        wanted = np.searchsorted(np.cumsum(self._steps), 0.99 * self._count)
        return min(1000 * _STEP_M * (int(wanted) + 1), self.max_mm)

    def facts(self) -> dict[str, float]:
        """Return the three numbers for a record, millimetres, rounded to a micrometre."""
        return {name: round(getattr(self, name), 3) for name in ("max_mm", "p99_mm", "rms_mm")}
