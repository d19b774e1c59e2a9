"""The joint layouts of SMPL, SMPL-H and SMPL-X, and conversion of poses between them."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.motions.joint_names import plain_name

__all__ = ["BODY_JOINTS", "FINGER_JOINTS", "HANDS", "LAYOUTS", "SMPL", "SMPL_H", "SMPL_X", "carry_over", "layout_of"]

BODY_JOINTS = SMPL_JOINT_NAMES[:22]
"""The joints that all three layouts begin with."""
FINGER_JOINTS = tuple(
    f"{side}_{finger}{number}"
    for side in "lr"
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for number in (1, 2, 3)
)
SMPL = SMPL_JOINT_NAMES
SMPL_H = BODY_JOINTS + FINGER_JOINTS
SMPL_X = (*BODY_JOINTS, "jaw", "l_eye", "r_eye", *FINGER_JOINTS)
LAYOUTS = {len(layout): layout for layout in (SMPL, SMPL_H, SMPL_X)}
"""Joint names by number of joints."""
HANDS = ("rest", "released")
"""Choices for the pose of SMPL's two hand joints if a file has fingers instead."""
# The released training code used the first 72 of SMPL-H's 156 values for SMPL, so two joints of the left index finger for
# hands.
_RELEASED_HANDS = {"l_hand": "l_index1", "r_hand": "l_index2"}


def layout_of(skeleton: Skeleton) -> tuple[str, ...] | None:
    """Return the joint names in order if the skeleton is that of SMPL, SMPL-H or SMPL-X, else None.

    Names are compared in any spelling; a skeleton without names (`joint_0` etc.) is recognised by its number of joints.
    """
    layout = LAYOUTS.get(skeleton.num_joints)
    is_nameless = all(re.fullmatch(r"joint_\d+", name) for name in skeleton.names)
    if layout is None or not (is_nameless or tuple(map(plain_name, skeleton.names)) == layout):
        return None
    return layout


def carry_over(poses: NDArray[np.float64], names: tuple[str, ...], wanted: tuple[str, ...], hands: str) -> NDArray[np.float64]:
    """Convert poses [T, K, 3] of the joints `names` to poses [T, J, 3] of the joints `wanted`.

    Joints in both keep their values; others are zero, except SMPL's hands with `hands="released"`.
    """
    values = np.zeros((len(poses), len(wanted), 3))
    for joint, name in enumerate(wanted):
        if name not in names and hands == "released":
            name = _RELEASED_HANDS.get(name, name)
        if name in names:
            values[:, joint] = poses[:, names.index(name)]
    return values
