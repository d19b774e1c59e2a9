"""Joints for posing by hand: labels by limb, three angles in degrees per joint, mirroring of left and right."""

from __future__ import annotations

import io
import re
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.bodies.skinning import transform_points
from snarfcli.motions.joint_names import find_body_parts
from snarfcli.names import unique_names
from snarfcli.texts import one_line

__all__ = [
    "ANGLE_LIMITS_DEG",
    "angles_of",
    "global_turns",
    "joint_labels",
    "mirrored_joint",
    "pose_file",
    "posed_joints",
    "vector_from_turn",
    "vector_of",
]

# Order of rotations: x first, then y, then z, each about the axes of the parent ("XYZ Euler" in Blender). With the middle angle
# within a quarter turn every rotation has one set of angles, so these limits exclude none.
_ORDER = "xyz"
ANGLE_LIMITS_DEG: tuple[float, float, float] = (180.0, 90.0, 180.0)
"""Maximum angle about x, y and z, degrees."""

_SIDES = {"l": "left", "r": "right"}
_LIMBS = (
    ("arm", ("collar", "shoulder", "elbow", "wrist", "hand")),
    ("hand", ("index", "middle", "pinky", "ring", "thumb")),
    ("leg", ("hip", "knee", "ankle", "foot")),
)
_LONGEST = 60  # characters of a name in a label
_HEAD = ("neck", "head", "jaw", "l_eye", "r_eye")


def angles_of(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return a rotation vector [3], radians, as angles in degrees about x, y and z."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # at a quarter turn about y many triples are equivalent
        x, y, z = Rotation.from_rotvec(vector).as_euler(_ORDER, degrees=True)
    return float(x), float(y), float(z)


def vector_of(angles: tuple[float, float, float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles in degrees about x, y and z as a rotation vector [3], radians."""
    return Rotation.from_euler(_ORDER, angles, degrees=True).as_rotvec()


def joint_labels(skeleton: Skeleton) -> dict[str, int]:
    """Return a label for each joint except the root, ordered by limbs: `left arm: elbow`, `trunk: spine2`, `Tail_03`."""
    body = find_body_parts(skeleton.names, skeleton.parents)
    part_of = {joint: part for part, joint in body.joints.items()}
    order = ["trunk", "head", *(f"{side} {limb}" for limb in ("arm", "hand", "leg") for side in _SIDES.values()), ""]
    limbs = {joint: _limb_of(joint, part_of.get(joint), body.spine) for joint in range(1, skeleton.num_joints)}
    joints = sorted(limbs, key=lambda joint: order.index(limbs[joint]))
    labels = []
    for joint in joints:
        name = one_line(skeleton.names[joint], _LONGEST) or f"joint {joint}"  # names come from a file
        labels.append(f"{limbs[joint]}: {_without_side(name)}" if limbs[joint] else name)
    return dict(zip(unique_names(labels), joints, strict=True))


def _limb_of(joint: int, part: str | None, spine: tuple[int, ...]) -> str:
    """Return the limb of a joint; empty if it is not a known part of a human body."""
    if joint in spine or part == "pelvis":
        return "trunk"
    if part is None:
        return ""
    if part in _HEAD:
        return "head"
    side, _, name = part.partition("_")
    plain = re.sub(r"\d+$", "", name)
    return next((f"{_SIDES[side]} {limb}" for limb, names in _LIMBS if plain in names and side in _SIDES), "")


def _without_side(name: str) -> str:
    """Return a joint name without the prefix for the side, as in SMPL, since the name of the limb has it already."""
    return name[2:] if name[:2] in ("l_", "r_") else name


def mirrored_joint(skeleton: Skeleton, joint: int, vector: NDArray[np.float64]) -> tuple[int, NDArray[np.float64]]:
    """Return the joint on the other side, and a rotation vector [3] of `joint` mirrored in the plane x = 0."""
    return skeleton.left_right[joint], vector * (1.0, -1.0, -1.0)


def posed_joints(skeleton: Skeleton, transforms: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the joints [J, 3] under bone transforms [J, 4, 4], canonical to posed, metres."""
    joints_c = skeleton.canonical_joints.cpu().numpy().astype(np.float32)
    return transform_points(transforms, joints_c)


def pose_file(pose: NDArray[np.float64], translation: NDArray[np.float64]) -> bytes:
    """Return one pose [J, 3] and its translation [3] as an .npz file that `--pose` reads, y up.

    The file states the up axis, since readers would otherwise take the axis along which the body stands, and it may lie.
    """
    buffer = io.BytesIO()
    np.savez(buffer, poses=pose.reshape(1, -1), trans=translation.reshape(1, 3), mocap_framerate=30.0, up=np.array("y"))
    return buffer.getvalue()


def global_turns(skeleton: Skeleton, transforms: NDArray[np.float32]) -> Rotation:
    """Return the rotations of the J joints from the rest pose, given bone transforms [J, 4, 4], canonical to posed."""
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])[0, :, :3, :3].cpu().numpy()
    return Rotation.from_matrix(transforms[:, :3, :3].astype(np.float64) @ canonical_from_rest)


def vector_from_turn(skeleton: Skeleton, transforms: NDArray[np.float32], joint: int, turn: Rotation) -> NDArray[np.float64]:
    """Return the rotation vector [3], relative to its parent, of a joint with the rotation `turn` from the rest pose."""
    parent = skeleton.parents[joint]
    return (turn if parent < 0 else global_turns(skeleton, transforms)[parent].inv() * turn).as_rotvec()
