"""Retarget the motion of one joint tree to the poses of another: bones keep their directions, feet stay near the floor.

Let R_S be the world rotation of a joint of the file relative to its rest pose. The joint of the skeleton gets the world
rotation R_S Q. Q is constant and rotates the rest pose of the skeleton to that of the file: first as a whole, for files that
face another way or lie at rest, then bone by bone, by the smallest rotation to the direction of the file's bone. So an arm that
is level in one rest pose and hangs in the other ends at the same place, and twist is kept.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.bodies.kinematics import nearest_rotation
from snarfcli.errors import UserError, nearest
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions.joint_names import find_body_parts
from snarfcli.motions.layouts import layout_of
from snarfcli.motions.mapping import map_joints
from snarfcli.motions.motion import Motion
from snarfcli.motions.rest_poses import RestMatch, rest_turns
from snarfcli.motions.up_axis import Up, up_axis, y_from_up

__all__ = ["choose_clip", "retarget"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_LEGS = (("l_hip", "l_knee"), ("l_knee", "l_ankle"), ("r_hip", "r_knee"), ("r_knee", "r_ankle"))
_MAX_DISTANCE_M = 1e6
_SAME_SKELETON_M = 1e-3  # maximum difference of joint positions, relative to their parents, in two files of one skeleton


def choose_clip(rig: Rig, clip: str | int | None, path: Path) -> RigClip:
    """Return the clip of a name or index, the first by default.

    Raises:
        UserError: the rig has no clip, or none of that name or index.
    """
    names = [each.name for each in rig.clips]
    if not names:
        raise UserError(f"{path} has no motion; export it with its animation")
    if clip is None:
        if len(names) > 1:
            shown = ", ".join(f"{number}: {name[:40]!r}" for number, name in enumerate(names[:20]))
            log.info("%s: clip 0 of %d is used; others by clip=NAME or number (%s)", path.name, len(names), shown)
        return rig.clips[0]
    if str(clip) in names:
        return rig.clips[names.index(str(clip))]
    if str(clip).isdecimal() and int(clip) < len(names):
        return rig.clips[int(clip)]
    found = ", ".join(f"{name[:40]!r}" for name in names[:20])
    raise UserError(f"{path} has no clip {clip!r:.60}{nearest(str(clip), names) or '.'} It has {found}")


def retarget(
    rig: Rig,
    clip: RigClip,
    skeleton: Skeleton,
    *,
    path: Path,
    name: str,
    up: Up = "auto",
    mapping: str | Path | Mapping[str, str | None] | None = None,
) -> Motion:
    """Convert a clip of a rig to poses of a skeleton.

    The bones of arms, legs and fingers get the directions of the file; for skeletons that are not human, all bones do. Trunk,
    head and feet get the rotations of the file. Joints without a counterpart follow their parents. Distances are scaled by the
    length of the legs, or of all bones if there are no legs, and the hips follow those of the file. A rig of the skeleton
    itself gives its own poses, even if its rest pose differs, as in exported avatars.

    Args:
        rig: source of the motion.
        clip: one of its clips.
        skeleton: the target; y is up at rest.
        path: file of the rig, for messages.
        name: name of the motion.
        up: up axis of the file; `auto`: the axis along which the body stands during the clip, or else at rest.
        mapping: see `map_joints`.

    Raises:
        UserError: the joints cannot be paired; the clip has no frames or contains numbers that are not finite; a joint has
            scale 0 at rest.
    """
    if not len(clip.world_from_joint):
        raise UserError(f"{path}: clip {clip.name[:40]!r}: wanted at least 1 frame, got 0; export it again")
    skeleton = replace(skeleton, names=layout_of(skeleton) or skeleton.names)  # joint_0 etc. are joints of SMPL
    pairs = map_joints(skeleton, rig, path, mapping)
    unpaired = [skeleton.names[joint] for joint in range(skeleton.num_joints) if joint not in pairs]
    if unpaired:
        log.info("%s: joints without a counterpart follow their parents: %s", path.name, ", ".join(unpaired))
    parts = find_body_parts(skeleton.names, skeleton.parents)
    joints_rest = skeleton.joints_rest.detach().cpu().double().numpy()
    straightened = _straightened(rig, skeleton, pairs)
    if up == "auto" and straightened is not rig and path.suffix.lower() in (".glb", ".gltf"):
        up = "y"  # the file was exported for this skeleton, so it follows the format; a lying body would mislead the guess
    rig = straightened
    match = RestMatch(pairs, parts.joints, parts.spine, joints_rest, rig.rest[:, :3, 3], skeleton.parents, rig.parents)
    if not np.isfinite(rig.rest).all():
        raise UserError(f"{path} has NaN or infinity in its rest pose; export it again")
    turns = rest_turns(match)
    root = Rotation.from_matrix(_turned(rig, clip, pairs[0], path) @ turns[0])
    axis = _up(root, turns[0]) if up == "auto" else up
    if up == "auto" and axis == "z":
        log.info("%s: z is up in this file and was turned to y", path.name)
    upright = np.eye(3) if axis == "y" else y_from_up(axis).as_matrix()

    rotations = {joint: upright @ _turned(rig, clip, number, path) @ turns[joint] for joint, number in pairs.items()}
    poses = _local_poses(rotations, skeleton.parents, len(clip.world_from_joint))
    translation = _translation(match, clip, rotations[0], upright)
    if not np.abs(translation).max() < _MAX_DISTANCE_M:
        raise UserError(f"{path}: the body moves over {_MAX_DISTANCE_M / 1000:g} km away; check the track of its root")
    return Motion(name, poses, translation, clip.frame_rate)


def _local_poses(rotations: Mapping[int, Array], parents: Sequence[int], frames: int) -> Array:
    """Return the poses [T, J, 3], axis-angle, radians, of joints with given world rotations; other joints follow their parents.

    Args:
        rotations: [T, 3, 3] per joint, world rotations; not all joints need one.
        parents: J parents, -1 for the root; a parent comes before its children.
        frames: number T of frames.
    """
    world = np.empty((frames, len(parents), 3, 3))
    poses = np.zeros((frames, len(parents), 3))
    for joint, parent in enumerate(parents):
        if joint not in rotations:
            world[:, joint] = world[:, parent] if parent >= 0 else np.eye(3)
            continue
        world[:, joint] = rotations[joint]
        local = world[:, joint] if parent < 0 else world[:, parent].transpose(0, 2, 1) @ world[:, joint]
        poses[:, joint] = Rotation.from_matrix(local).as_rotvec()
    return poses


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _straightened(rig: Rig, skeleton: Skeleton, pairs: Mapping[int, int]) -> Rig:
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


def _turned(rig: Rig, clip: RigClip, number: int, path: Path) -> Array:
    """Return the world rotations [T, 3, 3] of a joint of the rig relative to its rest, without scale."""
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


def _up(upright: Rotation, rest: Array) -> Up:
    """Return the up axis: that along which the body stands during the clip, or if that is not clear, at rest."""
    mean = upright.apply([0.0, 1.0, 0.0]).mean(0)
    return up_axis(upright if max(abs(mean[1]), abs(mean[2])) > 0.7 else Rotation.from_matrix(rest[None]))


def _translation(match: RestMatch, clip: RigClip, root_world: Array, upright: Array) -> Array:
    """Return the translation that puts the middle of the hips where the scaled file has it.

    Args:
        match: the paired joints.
        clip: the motion.
        root_world: [T, 3, 3], world rotations of the root of the skeleton.
        upright: [3, 3], rotation of the world to y up.

    Returns:
        [T, 3], metres.
    """
    hips = [match.parts[part] for part in ("l_hip", "r_hip") if match.parts.get(part) in match.pairs]
    hips = hips if len(hips) == 2 else [0]
    place = clip.world_from_joint[..., :3, 3][:, [match.pairs[joint] for joint in hips]].mean(1)
    with np.errstate(over="ignore", invalid="ignore"):
        place = _scale(match) * place @ upright.T
    root = match.target[0]
    return place - root_world @ (match.target[hips].mean(0) - root) - root


@np.errstate(over="ignore", invalid="ignore")
def _scale(match: RestMatch) -> float:
    """Return the metres per unit of the rig, from the length of the legs, or of all bones."""
    bones = []
    for upper, lower in _LEGS:
        start, end = match.both(upper), match.both(lower)
        if start is not None and end is not None:
            bones.append((np.linalg.norm(start[0] - end[0]), np.linalg.norm(start[1] - end[1])))
    if len(bones) < len(_LEGS):
        bones = [
            (
                np.linalg.norm(match.target[joint] - match.target[other]),
                np.linalg.norm(match.source[match.pairs[joint]] - match.source[match.pairs[other]]),
            )
            for joint, other in match.above.items()
        ]
    target, source = (sum(bone[side] for bone in bones) for side in (0, 1))
    return float(target / source) if source > 0 and np.isfinite(source) and target > 0 else 1.0
