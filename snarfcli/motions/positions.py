"""Recognise arrays of joint positions, which have the shapes of pose arrays but are no rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.anatomy import JOINTS_REST, PARENTS

__all__ = ["are_positions"]

Array = NDArray[np.float64]

# The bones of the 22 joints that SMPL, SMPL-H and SMPL-X begin with.
_ENDS = np.arange(1, 22)
_STARTS = np.array(PARENTS[1:22])
_LENGTHS = np.linalg.norm(JOINTS_REST[_ENDS] - JOINTS_REST[_STARTS], axis=1)
# Standard deviation of the logarithm of measured over average bone lengths: at most 0.07 for the built-in subjects, at least
# 0.32 for the axis-angle vectors of 240,000 random and 10,000 recorded and built-in poses.
_PROPORTIONS = 0.25
# A distance is constant if its standard deviation is below this times the square of the angle (rad) by which its direction
# turns, relative to its mean: two points that pass each other on straight lines, as rotations do in short clips, have 0.04.
_CONSTANT = 0.003
_TURNED_RAD = 0.03
_MIN_FRAMES = 8
_MAX_FRAMES = 64
# Share of the joints with such a partner, in 12 frames: over 0.5 in 98 of 100 pieces of recorded and built-in motions for
# positions, at most 0.12 for rotations.
_PARTNERED = 0.5


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def are_positions(values: Array) -> bool:
    """Return whether an array has the positions of joints rather than their rotations.

    Positions give themselves away in two ways. The bones of SMPL's tree have the proportions of a human body, also in a single
    frame. And whatever the order of the joints: nearly each of them keeps its distance to another one while the direction
    between the two changes. Axis-angle vectors have neither property.

    Args:
        values: [T, K, 3], in any unit and frame.
    """
    return values.size > 0 and (_has_proportions(values) or _is_rigid(values))


def _has_proportions(values: Array) -> bool:
    """Return whether the bones of SMPL's tree have the proportions of a body in most frames."""
    if values.shape[1] < 22:
        return False
    lengths = np.median(np.linalg.norm(values[:, _ENDS] - values[:, _STARTS], axis=2), axis=0)
    if not lengths.min() > 0:
        return False
    return float(np.log(lengths / _LENGTHS).std()) < _PROPORTIONS


def _is_rigid(values: Array) -> bool:
    """Return whether most joints move, at a constant distance from another moving joint whose direction from them changes."""
    values = values[:: -(-len(values) // _MAX_FRAMES)]
    joints = values.shape[1]
    # Of rotations, a joint that stays at zero would be the centre of any that turns by a constant angle.
    moving = np.flatnonzero(np.ptp(values, 0).max(1) > 1e-3 * np.abs(values).max())
    if len(values) < _MIN_FRAMES or joints < 6 or len(moving) < _PARTNERED * joints:
        return False
    partnered = 0
    for joint in moving:
        offsets = values[:, moving[moving != joint]] - values[:, joint : joint + 1]
        lengths = np.linalg.norm(offsets, axis=2)
        apart = lengths.min(0) > 0
        offsets, lengths = offsets[:, apart], lengths[:, apart]
        directions = offsets / lengths[..., None]
        turned = np.linalg.norm(directions - directions[:1], axis=2).max(0, initial=0)
        is_constant = lengths.std(0) < _CONSTANT * turned**2 * lengths.mean(0)
        partnered += bool((is_constant & (turned > _TURNED_RAD)).any())
    return partnered >= _PARTNERED * joints
