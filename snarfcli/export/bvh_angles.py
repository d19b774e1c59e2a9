"""Rotation matrices as Euler angles that change smoothly from frame to frame, for files that store angles."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["ORDERS", "choose_order", "continuous_angles"]

ORDERS = ("ZXY", "ZYX", "XYZ", "XZY", "YXZ", "YZX")
"""Orders of intrinsic rotations about three axes; the first is the most common one in BVH files of people."""

_CLEAR = np.cos(np.radians(80))
"""Cosine of the middle angle down to which the usual order is kept; at 90 degrees the outer axes coincide (gimbal lock)."""
_LOCKED = 1e-6  # cosine of the middle angle below which only the sum of the outer angles is known in float64
_EVEN = ("XYZ", "YZX", "ZXY")


def choose_order(rotations: NDArray[np.float64]) -> str:
    """Return the first of `ORDERS`, or the order farthest from gimbal lock if the first comes near it in any frame.

    Args:
        rotations: [T, 3, 3], rotation matrices of one joint.
    """
    clearest = {order: float(np.min(_middle_cosine(rotations, order), initial=1.0)) for order in ORDERS}
    usual = ORDERS[0]
    return usual if clearest[usual] >= _CLEAR else max(ORDERS, key=clearest.__getitem__)


def continuous_angles(rotations: NDArray[np.float64], order: str) -> NDArray[np.float64]:
    """Return the angles of rotations, each frame's nearest to those of the frame before.

    A rotation has two triples of angles, and each angle any multiple of 360 degrees more. Programs interpolate angles, so jumps
    between them would turn a joint the long way round. In gimbal lock the last angle keeps its value.

    Args:
        rotations: [T, J, 3, 3], rotation matrices.
        order: axes of the intrinsic rotations in the order of application, such as ZXY for R = Rz Rx Ry.

    Returns:
        [T, J, 3] degrees, in the order of the axes; those of the first frame are from -180 to 180.
    """
    if not rotations.size:
        return np.zeros(rotations.shape[:-1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # gimbal lock, which is handled below
        flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_euler(order, degrees=True)
    angles = flat.reshape(rotations.shape[:-1])
    locked = np.abs(np.cos(np.radians(angles[..., 1]))) < _LOCKED
    outer = np.where(angles[..., 1] > 0, 1.0, -1.0) * (1.0 if order in _EVEN else -1.0)
    for frame in range(1, len(angles)):
        before, here = angles[frame - 1], angles[frame]
        freed = here.copy()  # in gimbal lock first + outer * last is what counts
        freed[:, 0] += outer[frame] * (here[:, 2] - before[:, 2])
        freed[:, 2] = before[:, 2]
        here = np.where(locked[frame][:, None], freed, here)
        other = here * (1, -1, 1) + 180
        angles[frame] = _nearer(_unwrapped(here, before), _unwrapped(other, before), before)
    return angles


def _middle_cosine(rotations: NDArray[np.float64], order: str) -> NDArray[np.float64]:
    """Return the cosine [T] of the middle angle of rotations [T, 3, 3], from 0 to 1."""
    first, last = "XYZ".index(order[0]), "XYZ".index(order[2])
    return np.sqrt(np.clip(1 - rotations[:, first, last] ** 2, 0, 1))


def _unwrapped(angles: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles plus the multiples of 360 degrees that bring them within 180 degrees of others."""
    return angles - 360 * np.round((angles - before) / 360)


def _nearer(a: NDArray[np.float64], b: NDArray[np.float64], to: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rows [J, 3] of `a` or `b` that are nearer to those of `to`."""
    is_b = ((b - to) ** 2).sum(-1) < ((a - to) ** 2).sum(-1)
    return np.where(is_b[:, None], b, a)
