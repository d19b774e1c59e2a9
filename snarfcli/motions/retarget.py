"""Retarget the motion of one joint tree to the poses of another: bones keep their directions, feet stay near the floor.

Let R_S be the world rotation of a joint of the file relative to its rest pose. The joint of the skeleton gets the world
rotation R_S Q. Q is constant and rotates the rest pose of the skeleton to that of the file: first as a whole, for files that
face another way or lie at rest, then bone by bone, by the smallest rotation to the direction of the file's bone. So an arm that
is level in one rest pose and hangs in the other ends at the same place, and twist is kept. Where the rest pose of the file is
not that of a standing person, Q is found from the frames of the clip (`clip_turns`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError, nearest
from snarfcli.formats.gltf import GLTF_SUFFIXES
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions.clip_turns import all_limbs, clip_turns, disputed_limbs, doubtful_limbs, false_toes
from snarfcli.motions.joint_names import find_body_parts
from snarfcli.motions.layouts import layout_of
from snarfcli.motions.mapping import map_joints
from snarfcli.motions.motion import Motion
from snarfcli.motions.rest_match import RestMatch, unit
from snarfcli.motions.rest_poses import rest_turns
from snarfcli.motions.rig_rest import resting_in, straightened, turned
from snarfcli.motions.up_axis import Up, y_from_up

__all__ = ["Retargeted", "choose_clip", "retarget_rig"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_LEGS = (("l_hip", "l_knee"), ("l_knee", "l_ankle"), ("r_hip", "r_knee"), ("r_knee", "r_ankle"))
_MAX_DISTANCE_M = 1e6
_CLEAR = 0.7  # mean component of a unit vector along an axis that tells the up axis
_STRETCH = 0.2  # maximum relative difference between the lengths of bones at rest and in the clip


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A motion with the joints of the rig from which it was made."""

    motion: Motion
    """The motion of the skeleton."""
    source: Array
    """[T, K, 3], places of the rig's joints in the world of the motion, metres."""
    source_names: tuple[str, ...]
    """K names of the rig's joints."""
    source_parents: tuple[int, ...]
    """K parents, -1 for a root."""
    pairs: dict[int, int]
    """Per paired joint of the skeleton, the joint of the rig."""


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
    if str(clip).isdecimal() and len(str(clip)) < 10 and int(clip) < len(names):
        return rig.clips[int(clip)]
    found = ", ".join(f"{name[:40]!r}" for name in names[:20])
    raise UserError(f"{path} has no clip {clip!r:.60}{nearest(str(clip), names) or '.'} It has {found}")


def retarget_rig(
    rig: Rig,
    clip: RigClip,
    skeleton: Skeleton,
    *,
    path: Path,
    name: str,
    up: Up = "auto",
    rest: str = "auto",
    mapping: str | Path | Mapping[str, str | None] | None = None,
) -> Retargeted:
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
        rest: rest pose that is compared with that of the skeleton: `auto`, `file`, `clip` or the number of a frame, see
            `read_motion`.
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
    own = straightened(rig, skeleton, pairs)
    if up == "auto" and own is not rig and path.suffix.lower() in GLTF_SUFFIXES:
        up = "y"  # the file was exported for this skeleton, so it follows the format; a lying body would mislead the guess
    rig = resting_in(rig, clip, int(rest), path) if rest.isdecimal() else own
    match = RestMatch(pairs, parts.joints, parts.spine, joints_rest, rig.rest[:, :3, 3], skeleton.parents, rig.parents)
    if not np.isfinite(rig.rest).all():
        raise UserError(f"{path} has NaN or infinity in its rest pose; export it again")
    moved = {joint: turned(rig, clip, number, path) for joint, number in pairs.items()}
    posed = clip.world_from_joint[..., :3, 3]
    turns = _turns(match, moved, posed, rest, path)
    axis = _up(match, moved[0] @ turns[0], turns[0], posed) if up == "auto" else up
    if up == "auto" and axis != "y":
        log.info("%s: %s is up in this file and was turned to y (up=y keeps it)", path.name, axis)
    upright = np.eye(3) if axis == "y" else y_from_up(axis).as_matrix()

    rotations = {joint: upright @ moved[joint] @ turns[joint] for joint in pairs}
    poses = _local_poses(rotations, skeleton.parents, len(clip.world_from_joint))
    with np.errstate(over="ignore", invalid="ignore"):
        source = _scale(match, posed) * posed @ upright.T
    translation = _translation(match, source, rotations[0])
    if not np.abs(translation).max() < _MAX_DISTANCE_M:
        raise UserError(f"{path}: the body moves over {_MAX_DISTANCE_M / 1000:g} km away; check the track of its root")
    return Retargeted(Motion(name, poses, translation, clip.frame_rate), source, rig.names, rig.parents, pairs)


def _turns(match: RestMatch, moved: Mapping[int, Array], posed: Array, rest: str, path: Path) -> dict[int, Array]:
    """Return the rotation [3, 3] per paired joint from the rest pose of the skeleton to that of the rig.

    Args:
        match: the paired joints at rest.
        moved: [T, 3, 3] per paired joint, world rotations of the rig's joints relative to their rest.
        posed: [T, K, 3], places of the rig's joints.
        rest: which rest pose counts, as in `retarget_rig`.
        path: file of the rig, for messages.
    """
    turns = rest_turns(match, without_bone=false_toes(match, posed))
    if rest == "clip":
        if not all_limbs(match):
            raise UserError(f"{path}: rest=clip: wanted the skeleton of a person, got another; leave it out")
        return turns | clip_turns(match, all_limbs(match), turns, moved, posed)
    if rest != "auto":
        return turns
    limbs, suspected = doubtful_limbs(match)
    if suspected:
        limbs += disputed_limbs(match, suspected, turns, clip_turns(match, suspected, turns, moved, posed))
    if not limbs:
        return turns
    log.info(
        "%s: the rest pose is not that of a standing person (%s), so the frames of the clip were used instead (rest=file"
        " takes the rest pose as it is, rest=NUMBER that frame)",
        path.name,
        ", ".join(name.replace("l_", "left ").replace("r_", "right ") for name in limbs),
    )
    return turns | clip_turns(match, limbs, turns, moved, posed)


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


def _up(match: RestMatch, pelvis: Array, rest: Array, posed: Array) -> Up:
    """Return the up axis: that along which the body stands during the clip, or if that is not clear, at rest.

    Both the pelvis and the way from the ankles to the head tell how the body stands. An axis other than y and z counts only if
    clip and rest pose agree on it: a body may lie, or hang head down, for a whole clip.

    Args:
        match: the paired joints at rest.
        pelvis: [T, 3, 3], world rotations of the pelvis of the skeleton.
        rest: [3, 3], the same at rest.
        posed: [T, K, 3], places of the rig's joints.
    """
    clip, still = pelvis[:, :, 1].mean(0), rest[:, 1]
    joints = [match.pairs.get(match.parts.get(part, -1)) for part in ("head", "l_ankle", "r_ankle")]
    if None not in joints:
        head, left, right = (posed[:, joint] for joint in joints)
        standing = unit(head - (left + right) / 2).mean(0)
        clip = (clip + standing) / 2 if np.isfinite(standing).all() else clip
    axis = int(np.argmax(np.abs(clip)))
    if abs(clip[axis]) > _CLEAR and clip[axis] * still[axis] > 0 and abs(still[axis]) > _CLEAR:
        return cast(Up, ("" if clip[axis] > 0 else "-") + "xyz"[axis])
    clear = clip if max(abs(clip[1]), abs(clip[2])) > _CLEAR else still
    return "z" if abs(clear[2]) > abs(clear[1]) else "y"


def _translation(match: RestMatch, source: Array, root_world: Array) -> Array:
    """Return the translation [T, 3], metres, that puts the middle of the hips where the scaled rig has it.

    Args:
        match: the paired joints.
        source: [T, K, 3], places of the rig's joints in the world of the motion, metres.
        root_world: [T, 3, 3], world rotations of the root of the skeleton.
    """
    hips = [match.parts[part] for part in ("l_hip", "r_hip") if match.parts.get(part) in match.pairs]
    hips = hips if len(hips) == 2 else [0]
    place = source[:, [match.pairs[joint] for joint in hips]].mean(1)
    root = match.target[0]
    return place - root_world @ (match.target[hips].mean(0) - root) - root


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _scale(match: RestMatch, posed: Array) -> float:
    """Return the metres per unit of the rig, from the length of the legs, or of all bones.

    Args:
        match: the paired joints at rest.
        posed: [T, K, 3], places of the rig's joints. Their distances count where the rest pose has others, as in files whose
            bones have no length at rest, or are at rest in other units.
    """
    bones = [(match.parts.get(upper, -1), match.parts.get(lower, -1)) for upper, lower in _LEGS]
    if not all(joint in match.pairs for bone in bones for joint in bone):
        bones = [(above, joint) for joint, above in match.above.items()]
    if not bones:
        return 1.0
    above, below = np.array(bones).T
    upper, lower = ([match.pairs[joint] for joint in joints] for joints in (above, below))
    target = np.linalg.norm(match.target[below] - match.target[above], axis=1).sum()
    rest = np.linalg.norm(match.source[lower] - match.source[upper], axis=1).sum()
    moving = np.median(np.linalg.norm(posed[:, lower] - posed[:, upper], axis=2).sum(1))
    source = rest if abs(rest - moving) < _STRETCH * moving else moving
    return float(target / source) if source > 0 and np.isfinite(source) and target > 0 else 1.0
