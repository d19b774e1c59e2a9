"""Compare two rest poses: find the rotations that bring the joints of a skeleton to the rest pose of a rig."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.motions.rest_match import RestMatch, body_frame, smallest_turn

__all__ = ["rest_turns"]

Array = NDArray[np.float64]

# In the trunk and the feet, bone directions of two skeletons may differ although the rest poses are the same, because joints
# are placed differently (SMPL's neck leans 30 degrees forward). A difference up to the first angle is taken for that; from the
# second on, for a difference of the rest poses; in between the rotation grows continuously.
_PLACEMENT_RAD = (np.radians(35), np.radians(70))
_TRUNK = ("pelvis", "neck", "head", "jaw", "l_collar", "r_collar", "l_ankle", "r_ankle", "l_foot", "r_foot")


def rest_turns(match: RestMatch, without_bone: Collection[int] = ()) -> dict[int, Array]:
    """Return the rotation [3, 3] per paired joint of the skeleton from its rest pose to that of the rig.

    First the whole skeleton is aligned, for rigs that face another way or lie at rest. Then each bone gets the smallest
    rotation to the direction of the rig's bone. Trunk, head and feet are aligned as a whole only, unless they differ by a large
    angle.

    Args:
        match: the paired joints at rest.
        without_bone: joints of the skeleton whose bones in the rig must be ignored.
    """
    trunk = {*(match.parts[name] for name in _TRUNK if name in match.parts), *match.spine}
    whole = _alignment(match)
    turns: dict[int, Array] = {}
    for joint in match.pairs:
        is_trunk = joint in trunk
        # A hand continues the forearm; feet and head are upright independent of the direction of leg or neck.
        start = whole if is_trunk or joint not in match.above else turns[match.above[joint]]
        turns[joint] = start
        directions = match.bone(joint)
        if directions is None or joint in without_bone:
            continue
        turn = smallest_turn(start @ directions[0], directions[1])
        if is_trunk or not match.below[joint]:
            turn = _beyond_placement(turn)
        turns[joint] = turn @ start
    return turns


def _beyond_placement(turn: Array) -> Array:
    """Return the part of a rotation [3, 3] that joints placed differently do not explain."""
    vector = Rotation.from_matrix(turn).as_rotvec()
    start, end = _PLACEMENT_RAD
    share = np.clip((np.linalg.norm(vector) - start) / (end - start), 0, 1)
    return turn if share == 1 else Rotation.from_rotvec(share * vector).as_matrix()


def _alignment(match: RestMatch) -> Array:
    """Return the rotation [3, 3] that best aligns the whole skeleton at rest with the rig at rest."""
    target_frame, source_frame = body_frame(match.points(0)), body_frame(match.points(1))
    if target_frame is not None and source_frame is not None:
        return source_frame @ target_frame.T
    joints = list(match.pairs)
    target, source = match.target[joints], match.source[[match.pairs[joint] for joint in joints]]
    target, source = target - target.mean(0), source - source.mean(0)
    if np.linalg.matrix_rank(target, 1e-3 * np.abs(target).max(initial=0)) < 2 or not np.abs(source).max() > 0:
        return np.eye(3)
    moments = (source / np.abs(source).max()).T @ target
    return nearest_rotation(torch.from_numpy(moments)).numpy()
