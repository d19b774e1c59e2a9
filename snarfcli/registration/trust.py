"""Which frames of a fitted sequence can be trusted, and in plain words why others cannot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

__all__ = ["find_jumps", "is_suspicious", "judge", "usual_misfit"]

Array = NDArray[np.float64]

_SUSPICIOUS = 1.3  # times the usual misfit: such a frame is fitted again
_UNTRUSTED = 1.7  # frames with the right pose reach 1.5
_WINDOW = 61  # frames around one among which its misfit is judged
_JUMP_M = 0.15  # of a joint, between a frame and the middle of its neighbours
_USUAL_JUMP = 6.0  # times the median of the sequence


def usual_misfit(misfit: Array) -> Array:
    """Return the misfit [T] that is usual around each frame: the median of a window, at most 1.25 of that of the sequence."""
    middle = np.median(misfit)
    return np.minimum(median_filter(misfit, min(_WINDOW, len(misfit)), mode="nearest"), 1.25 * middle)


def is_suspicious(misfit: Array) -> NDArray[np.bool_]:
    """Return which frames [T] agree with their scans less than their neighbours do."""
    return misfit > _SUSPICIOUS * usual_misfit(misfit)


def find_jumps(joints: Array) -> NDArray[np.intp]:
    """Return for each frame [T] the number of the joint that jumps there and back, or -1.

    Of frames in a row that jump, only the one with the longest jump counts.

    Args:
        joints: [T, J, 3], metres.
    """
    jumps = np.full(len(joints), -1, np.intp)
    if len(joints) < 3:
        return jumps
    away = np.linalg.norm(joints[1:-1] - (joints[:-2] + joints[2:]) / 2, axis=2)
    most = away.max(1)
    around = np.maximum(np.append(most[1:], 0.0), np.append(0.0, most[:-1]))
    is_jump = (most > max(_JUMP_M, _USUAL_JUMP * float(np.median(most)))) & (most >= around)
    jumps[1:-1][is_jump] = away.argmax(1)[is_jump]
    return jumps


def judge(misfit: Array, residual_m: Array, jumps: NDArray[np.intp], joint_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return for each frame why it cannot be trusted; "" if it can.

    Args:
        misfit: [T], as in `Agreement`.
        residual_m: [T], metres.
        jumps: [T], as from `find_jumps`.
        joint_names: of the joints.
    """
    usual = np.median(residual_m)
    is_lost = misfit > _UNTRUSTED * usual_misfit(misfit)
    beside_lost = np.append(is_lost[1:], False) | np.append(False, is_lost[:-1])
    reasons = []
    for frame, joint in enumerate(jumps):
        if is_lost[frame]:
            millimetres = f"{1000 * residual_m[frame]:.1f} mm from the points; usual in this sequence: {1000 * usual:.1f} mm"
            reasons.append(f"the body is {millimetres}")
        elif joint >= 0 and not beside_lost[frame]:  # the jump is then that of its neighbour
            reasons.append(f"joint {joint_names[joint]} jumps between this frame and its neighbours")
        else:
            reasons.append("")
    return tuple(reasons)
