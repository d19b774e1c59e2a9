"""The motion of a file on the file's own skeleton."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.kinematics import pose_from_transforms
from snarfcli.errors import UserError
from snarfcli.export.clips import Clip
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions import Motion
from snarfcli.motions.joint_names import find_body_parts

__all__ = ["rig_clip", "up_axis_of"]

_RIGID = 1e-4  # difference of rotation matrices, and of joint positions as a share of the size of the skeleton


def rig_clip(rig: Rig, clip: RigClip, path: str | Path) -> tuple[Skeleton, Clip]:
    """Return the skeleton of a rig, and one of its clips as poses of that skeleton.

    Axes of the joints at rest become those of the world, which changes no position of a joint or vertex. Units and axes of the
    world are those of the file, not metres.

    Args:
        rig: a rig that was read.
        clip: one of its clips.
        path: file of the rig, for messages.

    Returns:
        The skeleton, whose canonical pose is its rest pose, and the clip; with bone transforms if joints change their size or
        their distance from their parents, which poses cannot express.

    Raises:
        UserError: the clip has no frames, numbers overflow, or a joint has scale 0 at rest.
    """
    if not len(clip.world_from_joint):
        raise UserError(f"{path}: clip {clip.name[:40]!r}: wanted at least 1 frame, got 0; export it again")
    rest = np.asarray(rig.rest, dtype=np.float64)
    with np.errstate(all="ignore"):
        volume = np.abs(np.linalg.det(rest[:, :3, :3] / np.linalg.norm(rest[:, :3, :3], axis=1, keepdims=True)))
    if not (volume > 1e-6).all():
        joint = rig.names[int(np.argmin(np.nan_to_num(volume)))]
        raise UserError(f"{path}: joint {joint[:40]!r} has scale 0 at rest; export it without scale 0")
    with np.errstate(all="ignore"):
        moved = clip.world_from_joint @ np.linalg.inv(rest)
    if not np.isfinite(moved).all() or not np.abs(moved).max() < 1e100:
        raise UserError(f"{path}: clip {clip.name[:40]!r} has numbers too large to add up; export it again")
    joints = torch.from_numpy(rest[:, :3, 3].copy())
    skeleton = Skeleton(rig.names, rig.parents, joints, torch.zeros_like(joints))
    poses, translation, _ = pose_from_transforms(torch.from_numpy(moved), rig.parents, joints)
    again = skeleton.posed_from_rest(poses, translation).numpy()
    motion = Motion(clip.name, poses.numpy(), translation.numpy(), clip.frame_rate)
    return skeleton, Clip(motion, None if _agree(again, moved, rest[:, :3, 3]) else moved)


def _agree(a: NDArray[np.float64], b: NDArray[np.float64], joints: NDArray[np.float64]) -> bool:
    """Return whether transforms [T, J, 4, 4] turn alike and put the joints [J, 3] in the same places."""
    size = max(float(np.ptp(joints, axis=0).max()), 1e-30)
    apart = a - b
    places = np.einsum("tjab,jb->tja", apart[..., :3, :3], joints) + apart[..., :3, 3]
    return bool(np.abs(apart[..., :3, :3]).max() < _RIGID and np.abs(places).max() < _RIGID * size)


def up_axis_of(skeleton: Skeleton, clip: Clip) -> str:
    """Return the axis, y or z, along which a human body stands on average over a clip; y for other skeletons."""
    parts = find_body_parts(skeleton.names, skeleton.parents).joints
    tops = [parts[name] for name in ("head", "neck", "l_shoulder", "r_shoulder") if name in parts][:1]
    hips = [parts[name] for name in ("l_hip", "r_hip", "pelvis") if name in parts]
    if not tops or not hips:
        return "y"
    rest = skeleton.joints_rest.numpy()
    posed = clip.bone_transforms
    if posed is None:
        motion = clip.motion
        posed = skeleton.posed_from_rest(torch.from_numpy(motion.poses), torch.from_numpy(motion.translation)).numpy()
    places = np.einsum("tjab,jb->tja", posed[..., :3, :3], rest) + posed[..., :3, 3]
    above = (places[:, tops].mean(1) - places[:, hips].mean(1)).mean(0)
    return "z" if abs(above[2]) > abs(above[1]) else "y"
