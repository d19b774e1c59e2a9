"""From the motion of one joint tree to poses of another: bones point the same way, feet stay near the floor.

With R_S the world rotation of a joint of the file relative to its rest pose, the joint of the skeleton gets R_S Q in the world.
Q is constant. It turns the rest pose of the skeleton into that of the file: first as a whole, which makes up for files that
face another way or lie at rest, then bone by bone, by the smallest turn that makes the bone point as the file's. So an arm that
rests level here and hangs there ends up in the same place, and twist is passed on.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
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
from snarfcli.motions.up_axis import Up, up_axis, y_from_z_up

__all__ = ["choose_clip", "retarget"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_LEGS = (("l_hip", "l_knee"), ("l_knee", "l_ankle"), ("r_hip", "r_knee"), ("r_knee", "r_ankle"))
_FARTHEST_M = 1e6
_SAME_SKELETON_M = 1e-3  # how far apart joints may be, from their parents, in two files of one skeleton


def choose_clip(rig: Rig, clip: str | int | None, path: Path) -> RigClip:
    """Return the clip of a name or number, the first by default.

    Raises:
        UserError: the rig has no clip, or none of that name or number.
    """
    names = [each.name for each in rig.clips]
    if not names:
        raise UserError(f"{path} has no motion in it; export it with its animation")
    if clip is None:
        if len(names) > 1:
            shown = ", ".join(f"{number}: {name[:40]!r}" for number, name in enumerate(names[:20]))
            log.info("%s: clip 0 of %d is taken; others by clip=NAME or number (%s)", path.name, len(names), shown)
        return rig.clips[0]
    if str(clip) in names:
        return rig.clips[names.index(str(clip))]
    if str(clip).isdecimal() and int(clip) < len(names):
        return rig.clips[int(clip)]
    hint = nearest(str(clip), names) or "."
    raise UserError(f"{path} has no clip {clip!r:.60}{hint} It has {', '.join(f'{name[:40]!r}' for name in names[:20])}")


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
    """Turn a clip of a rig into poses of a skeleton.

    Bones of arms, legs and fingers, and of skeletons that are no human body all bones, point as they do in the file. The trunk,
    the head and the feet turn as they do there. Joints without a counterpart follow their parents. Ways are scaled by the
    length of the legs, or of all bones where there are none, and the hips go where the file's go. A rig of the skeleton itself
    gives its poses back, also if it rests in another pose, as exported avatars do.

    Args:
        rig: where the motion comes from.
        clip: one of its clips.
        skeleton: the target; y is up at rest.
        path: file of the rig, for messages.
        name: what the motion is called.
        up: which way is up in the file; `auto`: the axis along which the body stands, over the clip or else at rest.
        mapping: see `map_joints`.

    Raises:
        UserError: the joints cannot be paired; the clip has no frames or holds numbers that are not finite; a joint has no size
            at rest.
    """
    if not len(clip.world_from_joint):
        raise UserError(f"{path}: clip {clip.name[:40]!r} has zero frames; export it again")
    skeleton = replace(skeleton, names=layout_of(skeleton) or skeleton.names)  # joint_0 and so on are SMPL's
    pairs = map_joints(skeleton, rig, path, mapping)
    left = [skeleton.names[joint] for joint in range(skeleton.num_joints) if joint not in pairs]
    if left:
        log.info("%s: without a counterpart, so they follow their parents: %s", path.name, ", ".join(left))
    parts = find_body_parts(skeleton.names, skeleton.parents)
    joints_rest = skeleton.joints_rest.detach().cpu().double().numpy()
    straightened = _straightened(rig, skeleton, pairs)
    if up == "auto" and straightened is not rig and path.suffix.lower() in (".glb", ".gltf"):
        up = "y"  # whoever wrote it knows this skeleton, and so the format; a body that lies would mislead the guess
    rig = straightened
    match = RestMatch(pairs, parts.joints, parts.spine, joints_rest, rig.rest[:, :3, 3], skeleton.parents, rig.parents)
    if not np.isfinite(rig.rest).all():
        raise UserError(f"{path} holds NaN or infinity in its rest pose; export it again")
    turns = rest_turns(match)
    root = Rotation.from_matrix(_turned(rig, clip, pairs[0], path) @ turns[0])
    axis = _up(root, turns[0]) if up == "auto" else up
    if up == "auto" and axis == "z":
        log.info("%s: z is up in this file and was turned to y", path.name)
    upright = y_from_z_up().as_matrix() if axis == "z" else np.eye(3)

    world = np.empty((len(clip.world_from_joint), skeleton.num_joints, 3, 3))
    poses = np.zeros((len(world), skeleton.num_joints, 3))
    for joint, parent in enumerate(skeleton.parents):
        if joint in pairs:
            world[:, joint] = upright @ _turned(rig, clip, pairs[joint], path) @ turns[joint]
        else:
            world[:, joint] = world[:, parent] if parent >= 0 else np.eye(3)
            continue
        local = world[:, joint] if parent < 0 else world[:, parent].transpose(0, 2, 1) @ world[:, joint]
        poses[:, joint] = Rotation.from_matrix(local).as_rotvec()
    translation = _way(match, clip, world[:, 0], upright)
    if not np.abs(translation).max() < _FARTHEST_M:
        raise UserError(f"{path}: the body goes over {_FARTHEST_M / 1000:g} km away; check the numbers of its root")
    return Motion(name, poses, translation, clip.frame_rate)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _straightened(rig: Rig, skeleton: Skeleton, pairs: Mapping[int, int]) -> Rig:
    """Return a rig of the skeleton's own joints with the skeleton's rest pose, whatever pose it rests in; any other as it is.

    It is the same skeleton if each joint lies where the skeleton has it, seen from its parent's frame.
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
        raise UserError(f"{path}: joint {rig.names[number][:40]!r} is at NaN or infinity in frame {frame}; export it again")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        size = np.linalg.norm(rest, axis=0)
        volume = np.linalg.det(rest / size)
    if not abs(volume) > 1e-6:
        raise UserError(f"{path}: joint {rig.names[number][:40]!r} has no size at rest; export it without scale 0")
    with np.errstate(over="ignore", invalid="ignore"):
        moved = posed[:, :3, :3] @ np.linalg.inv(rest)
        largest = np.abs(moved).max()
        moved = moved if 1e-3 < largest < 1e3 else moved / (np.abs(moved).max((1, 2), keepdims=True) + 1e-300)
    if not np.isfinite(moved).all():
        raise UserError(f"{path}: joint {rig.names[number][:40]!r} is scaled beyond all numbers; export it again")
    is_rotation = np.abs(moved.transpose(0, 2, 1) @ moved - np.eye(3)).max() < 1e-12 and np.linalg.det(moved).min() > 0
    return moved if is_rotation else nearest_rotation(torch.from_numpy(moved)).numpy()


# --- where the body goes -----------------------------------------------------------------------------------------------------


def _up(upright: Rotation, rest: Array) -> Up:
    """Return which way is up: as the body stands over the clip, or where that is not clear, as it stands at rest."""
    mean = upright.apply([0.0, 1.0, 0.0]).mean(0)
    return up_axis(upright if max(abs(mean[1]), abs(mean[2])) > 0.7 else Rotation.from_matrix(rest[None]))


def _way(match: RestMatch, clip: RigClip, root_world: Array, turn: Array) -> Array:
    """Return the translation [T, 3], metres, that puts the middle of the hips where the scaled file has it."""
    hips = [match.parts[part] for part in ("l_hip", "r_hip") if match.parts.get(part) in match.pairs]
    hips = hips if len(hips) == 2 else [0]
    place = clip.world_from_joint[..., :3, 3][:, [match.pairs[joint] for joint in hips]].mean(1)
    with np.errstate(over="ignore", invalid="ignore"):
        place = _scale(match) * place @ turn.T
    root = match.target[0]
    return place - root_world @ (match.target[hips].mean(0) - root) - root


@np.errstate(over="ignore", invalid="ignore")
def _scale(match: RestMatch) -> float:
    """Return metres for each unit of the rig, by the length of the legs, or of all bones."""
    bones = []
    for upper, lower in _LEGS:
        ends = match.both(upper), match.both(lower)
        if all(end is not None for end in ends):
            bones.append(tuple(np.linalg.norm(ends[0][side] - ends[1][side]) for side in (0, 1)))
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
