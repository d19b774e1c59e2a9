"""Whether numbers can be angles of joints in radians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["angle_problem"]

# Angles of joints are below pi, or below 2 pi if unwrapped. In degrees, some joint of a body exceeds these 12.6 in nearly every
# frame. The root is left out, since it may rotate several times.
_DEGREES = 4 * np.pi
_MAX_ANGLE = 1e4


def angle_problem(poses: NDArray[np.float64]) -> str:
    """Return why poses [T, J, 3] cannot be axis-angle vectors in radians, as the end of a message; empty if they can."""
    largest = np.abs(poses).max(initial=0.0)
    if poses.shape[1] > 1 and len(poses) and np.median(np.abs(poses[:, 1:]).max((1, 2))) > _DEGREES:
        return f"wanted angles in radians, got degrees, up to {largest:.5g}; save them in radians"
    if largest > _MAX_ANGLE:
        return f"wanted angles in radians, got {largest:.5g}; repair the file"
    return ""
