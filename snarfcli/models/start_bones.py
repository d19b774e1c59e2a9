"""The start bones of a Broyden search on a given skeleton."""

from __future__ import annotations

from dataclasses import replace

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.deformer import SearchConfig
from snarfcli.errors import UserError

__all__ = ["with_start_bones"]

# Those of the papers' released code: about one for each rigid part of a body.
_PAPERS_BONES = ("pelvis", "l_hip", "r_hip", "l_knee", "r_knee", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow")


def with_start_bones(search: SearchConfig, skeleton: Skeleton) -> SearchConfig:
    """Return the search with the start bones of a skeleton.

    An empty list becomes the papers' nine bones where the joints are SMPL's, and all bones elsewhere.

    Raises:
        UserError: the skeleton does not have a given bone.
    """
    bones, count = search.init_bones, skeleton.num_joints
    if bones is None:
        return search
    if not bones:
        is_smpl = skeleton.names == SMPL_JOINT_NAMES
        return replace(search, init_bones=[SMPL_JOINT_NAMES.index(name) for name in _PAPERS_BONES] if is_smpl else None)
    if not all(0 <= bone < count for bone in bones):
        raise UserError(f"search.init_bones: wanted bones from 0 to {count - 1}, got {bones}; null starts from all bones")
    return search
