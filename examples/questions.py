"""Read an avatar and ask it things: occupancy, side of the surface, skinning weights, Jacobians, and where its points go.

Run it with `python examples/questions.py outputs/builtin/50002/demo/avatar.pt` (the avatar of `make demo`).

The packages of the extra `commands` are needed (`pip install '.[commands]'`).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from snarf import Avatar

POINTS = 20000


def bent_pose(avatar: Avatar) -> Tensor:
    """Return a pose [1, J, 3], axis-angle, radians, in which every third joint but the root is a little bent."""
    pose = torch.zeros(1, avatar.skeleton.num_joints, 3)
    pose[0, 1::3, 2] = 0.4
    return pose


def points_around(avatar: Avatar, pose: Tensor) -> Tensor:
    """Return random points [1, N, 3] in the box of the posed body, metres."""
    lower, upper = avatar.posed_box(avatar.bone_transforms(pose)[0])
    return (lower + torch.rand(POINTS, 3) * (upper - lower))[None].cpu()


def occupancy(avatar: Avatar, points: Tensor, pose: Tensor) -> Tensor:
    """Return the probability [N] that posed points are inside. A point without correspondence is outside."""
    return avatar.occupancy(points, pose)[0]


def sides(avatar: Avatar, points: Tensor, pose: Tensor) -> Tensor:
    """Return 1 for points inside and -1 for points outside, [N]: the sign of the logit, which is 0 on the surface."""
    logits = avatar.query(points, avatar.bone_transforms(pose), pose).logits[0]
    return logits.sign()


def correspondences(avatar: Avatar, points: Tensor, pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return all roots: canonical points [M, 3], the point [M] each belongs to, and Jacobians [M, 3, 3] of forward skinning."""
    from snarfcli.models.fast_snarf import FoundRoots

    answer = avatar.find(points, avatar.bone_transforms(pose), pose)
    if not isinstance(answer, FoundRoots):
        raise ValueError("wanted an avatar with forward skinning (model=fast_snarf or snarf)")
    found = answer.roots
    return found.canonical, found.query, torch.linalg.inv(found.jacobian_inverse)


def answers(avatar: Avatar, seed: int = 0) -> dict[str, float]:
    """Return some facts about an avatar in a bent pose.

    They are the number of points inside, of roots, and of points with several roots; the volume in litres; the largest distance
    in mm between a point and the skinned position of its roots; and the mean factor by which skinning changes the volume there.
    """
    torch.manual_seed(seed)
    pose = bent_pose(avatar)
    points = points_around(avatar, pose)
    inside = occupancy(avatar, points, pose) > 0.5
    assert bool(((sides(avatar, points, pose) > 0) == inside).all())
    canonical, query, jacobians = correspondences(avatar, points, pose)
    transforms = avatar.bone_transforms(pose)[0]
    returned = avatar.skin(canonical, transforms)
    lower, upper = avatar.posed_box(transforms)
    return {
        "points inside": float(inside.sum()),
        "roots": float(len(query)),
        "points with several roots": float((torch.bincount(query, minlength=POINTS) > 1).sum()),
        "volume in litres": 1e3 * float((upper - lower).prod() * inside.float().mean()),
        "largest distance in mm": 1e3 * float((returned - points[0][query]).norm(dim=1).max()),
        "mean change of volume": float(torch.linalg.det(jacobians).mean()),
    }


def heaviest_bones(avatar: Avatar) -> dict[str, str]:
    """Return the bone with the largest skinning weight, and this weight, at the canonical place of each joint."""
    joints = avatar.skeleton.canonical_joints
    largest, bone = avatar.skinning_weights(joints).max(1)
    names = avatar.skeleton.names
    return {
        name: f"{names[owner]} ({weight:.2f})"
        for name, owner, weight in zip(names, bone.tolist(), largest.tolist(), strict=True)
    }


if __name__ == "__main__":
    from snarf import Avatar

    parser = argparse.ArgumentParser(description="Ask an avatar things.")
    parser.add_argument("avatar", type=Path, help="avatar.pt of a run, or a folder that save_pretrained wrote")
    path = parser.parse_args().avatar
    read = Avatar.from_pretrained(path) if path.is_dir() else Avatar.load(path)
    for question, answer in answers(read).items():
        print(f"{question:<26} {answer:.6g}")
    for joint, owner in heaviest_bones(read).items():
        print(f"{joint:<26} {owner}")
