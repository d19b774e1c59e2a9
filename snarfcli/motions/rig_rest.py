"""The rest pose of a rig: as in the file, of the skeleton itself, or a frame of a clip; and rotations relative to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.errors import UserError
from snarfcli.formats.rig import Rig, RigClip

__all__ = ["check_rest", "resting_in", "straightened", "turned"]

Array = NDArray[np.float64]

_RESTS = ("auto", "file", "clip")  # choices besides the number of a frame
_DIGITS = 10  # of the number of a frame
_SAME_SKELETON_M = 1e-3  # maximum difference of joint positions, relative to their parents, in two files of one skeleton


def check_rest(rest: str) -> None:
    """Raise UserError if `rest` is neither in `RESTS` nor the number of a frame."""
    if rest not in _RESTS and not (rest.isdecimal() and len(rest) < _DIGITS):
        raise UserError(f"rest: wanted {', '.join(_RESTS)} or the number of a frame, got {rest!r:.60}")


def resting_in(rig: Rig, clip: RigClip, frame: int, path: Path) -> Rig:
    """Return the rig with a frame of the clip as its rest pose.

    Raises:
        UserError: the clip has no such frame.
    """
    if frame >= len(clip.world_from_joint):
        raise UserError(f"{path}: rest={frame}: wanted a frame from 0 to {len(clip.world_from_joint) - 1}")
    return replace(rig, rest=clip.world_from_joint[frame])


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def straightened(rig: Rig, skeleton: Skeleton, pairs: Mapping[int, int]) -> Rig:
    """Return a rig of the skeleton itself in the rest pose of the skeleton; any other rig unchanged.

    A rig is of the skeleton itself if the positions of all joints relative to the frames of their parents agree.
    """
    parents = [rig.parents[pairs[joint]] if joint in pairs else None for joint in range(skeleton.num_joints)]
    if any(parent != pairs.get(own, -1) for parent, own in zip(parents, skeleton.parents, strict=True)):
        return rig
    frames = rig.rest[[pairs[joint] for joint in range(skeleton.num_joints)]]
    joints_rest = skeleton.joints_rest.detach().cpu().double().numpy()
    below = [joint for joint, parent in enumerate(skeleton.parents) if parent >= 0]
    above = [skeleton.parents[joint] for joint in below]
    try:
        local = np.linalg.solve(frames[above], frames[below])[:, :3, 3]
    except np.linalg.LinAlgError:
        return rig
    wanted = joints_rest[below] - joints_rest[above]
    scale = (local * wanted).sum() / max((wanted * wanted).sum(), 1e-30)
    if not scale > 0 or np.abs(local / scale - wanted).max() > _SAME_SKELETON_M:
        return rig
    sizes = np.linalg.norm(frames[:, :3, :3], axis=1)  # of the axes
    rest = rig.rest.copy()
    for joint, number in pairs.items():
        rest[number, :3, :3] = np.diag(sizes[joint])
        rest[number, :3, 3] = frames[0, :3, 3] + scale * sizes[0].mean() * (joints_rest[joint] - joints_rest[0])
    return replace(rig, rest=rest)


def turned(rig: Rig, clip: RigClip, number: int, path: Path) -> Array:
    """Return the world rotations [T, 3, 3] of a joint of the rig relative to its rest, without scale.

    Raises:
        UserError: the joint has scale 0 at rest, or numbers that are not finite.
    """
    rest = rig.rest[number, :3, :3]
    posed = clip.world_from_joint[:, number]
    if not np.isfinite(posed).all():
        frame = int(np.argwhere(~np.isfinite(posed))[0][0])
        raise UserError(f"{path}: joint {rig.names[number][:40]!r} has NaN or infinity in frame {frame}; export it again")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        size = np.linalg.norm(rest, axis=0)
        volume = np.linalg.det(rest / size)
    if not abs(volume) > 1e-6:
        raise UserError(f"{path}: joint {rig.names[number][:40]!r} has scale 0 at rest; export it without scale 0")
    with np.errstate(over="ignore", invalid="ignore"):
        moved = posed[:, :3, :3] @ np.linalg.inv(rest)
        largest = np.abs(moved).max()
        moved = moved if 1e-3 < largest < 1e3 else moved / (np.abs(moved).max((1, 2), keepdims=True) + 1e-300)
    if not np.isfinite(moved).all():
        raise UserError(f"{path}: joint {rig.names[number][:40]!r} has a scale that overflows; export it again")
    is_rotation = np.abs(moved.transpose(0, 2, 1) @ moved - np.eye(3)).max() < 1e-12 and np.linalg.det(moved).min() > 0
    return moved if is_rotation else nearest_rotation(torch.from_numpy(moved)).numpy()
