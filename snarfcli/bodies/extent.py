"""The extent of a subject in the canonical frame, estimated from posed meshes and the skeleton."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.bodies.skeleton import Skeleton

__all__ = ["bone_owners", "bone_segments", "unpose_by_nearest_bone", "weight_segments"]


def _living_bones(skeleton: Skeleton) -> list[tuple[int, int]]:
    """Return the bones (parent, child) whose joint moves a part of the subject."""
    return [(parent, child) for parent, child in skeleton.bones if parent not in skeleton.idle]


def bone_segments(skeleton: Skeleton, joints: Tensor | None = None) -> Tensor:
    """Return the ends (parent, child) of the bones, [S, 2, 3], metres, in the canonical frame unless `joints` are given.

    A root without children is a point. Joints that move nothing have no bones.
    """
    joints = skeleton.canonical_joints if joints is None else joints
    alone = [(joint, joint) for joint in _leaves(skeleton) if skeleton.parents[joint] < 0]
    return torch.stack([torch.stack([joints[parent], joints[child]]) for parent, child in _living_bones(skeleton) + alone])


def bone_owners(skeleton: Skeleton) -> list[int]:
    """Return the joint that moves each segment of `bone_segments`: the parent."""
    alone = [leaf for leaf in _leaves(skeleton) if skeleton.parents[leaf] < 0]
    return [parent for parent, _ in _living_bones(skeleton)] + alone


def weight_segments(skeleton: Skeleton, *, continued: bool = False) -> tuple[Tensor, list[int]]:
    """Return the segments [S, 2, 3] that move with each joint, canonical frame, metres, and their joints, S numbers.

    A joint moves the segments to its children; a joint without children moves the point where it is, or, if `continued`, the
    continuation of the bone that ends there, as long as the bone: toes, fingers and the skull lie beyond the last joints.
    Joints that move nothing have no segments.
    """
    joints = skeleton.canonical_joints
    ends = [(start, joints[end]) for start, end in _living_bones(skeleton)]
    for leaf in _leaves(skeleton):
        before = skeleton.parents[leaf] if continued and skeleton.parents[leaf] >= 0 else leaf
        ends.append((leaf, 2 * joints[leaf] - joints[before]))
    return torch.stack([torch.stack([joints[start], end]) for start, end in ends]), [start for start, _ in ends]


def unpose_by_nearest_bone(vertices: Tensor, bone_transforms: Tensor, skeleton: Skeleton) -> Tensor:
    """Move posed surface points rigidly back with their nearest bone: a rough canonical shape without skinning weights.

    Args:
        vertices: [V, 3], posed, metres.
        bone_transforms: [J, 4, 4], canonical to posed.
        skeleton: its bones.

    Returns:
        [V, 3], canonical frame, metres; wrong by a few centimetres near bent joints.
    """
    joints = skeleton.canonical_joints.to(vertices)
    leaves = [(joint, joint) for joint in _leaves(skeleton)]
    # Points beyond a last joint (fingers, toes, skull) are as near to that joint as to the end of its parent's bone.
    pairs = torch.tensor(leaves + _living_bones(skeleton))
    ends, moved = joints[pairs], bone_transforms[pairs[:, 0]]
    posed = torch.einsum("src,sec->ser", moved[:, :3, :3], ends) + moved[:, None, :3, 3]
    along = posed[:, 1] - posed[:, 0]
    offset = vertices[:, None] - posed[:, 0]
    share = ((offset * along).sum(-1) / (along * along).sum(-1).clamp_min(1e-12)).clamp(0, 1)
    distance = (offset - share[..., None] * along).norm(dim=-1)
    distance[:, : len(leaves)] -= 1e-4  # so that the last joint wins
    nearest = distance.argmin(1)
    inverse = torch.linalg.inv(moved)[nearest]
    return (inverse[:, :3, :3] @ vertices[:, :, None])[:, :, 0] + inverse[:, :3, 3]


def _leaves(skeleton: Skeleton) -> list[int]:
    """Return the joints without children that move a part of the subject."""
    return sorted(set(range(skeleton.num_joints)) - {parent for parent, _ in skeleton.bones} - set(skeleton.idle))
