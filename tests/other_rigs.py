"""Motions on rigs as other programs have them: rest poses, joints' frames, proportions, names, units and axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from toy_rigs import CMU_NAMES, MIXAMO_NAMES, a_pose

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS
from snarfcli.motions.motion import Motion

__all__ = ["CONVENTIONS", "Convention", "RigMotion", "rig_motion"]

Array = NDArray[np.float64]

_JOINT = {name: joint for joint, name in enumerate(SMPL_JOINT_NAMES)}
_LEGS = [_JOINT[f"{side}_{part}"] for side in "lr" for part in ("hip", "knee", "ankle", "foot")]
_LIMBS = [*_LEGS, *(_JOINT[f"{side}_{part}"] for side in "lr" for part in ("collar", "shoulder", "elbow", "wrist", "hand"))]


def _sided(middle: str, sided: str, form: str) -> tuple[str, ...]:
    """Return 24 names from those of pelvis, spine, neck, head; and hip, knee, ..., hand, which `form` completes."""
    middles = dict(zip(("pelvis", "spine1", "spine2", "spine3", "neck", "head"), middle.split(), strict=True))
    parts = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand")
    sides = dict(zip(parts, sided.split(), strict=True))
    full = {"l": "left", "r": "right"}
    return tuple(
        middles[name] if name in middles else form.format(side=full[name[0]], s=name[0], name=sides[name[2:]])
        for name in SMPL_JOINT_NAMES
    )


UNREAL_NAMES = _sided(
    "pelvis spine_01 spine_02 spine_03 neck_01 head",
    "thigh calf foot ball clavicle upperarm lowerarm hand middle_01",
    "{name}_{s}",
)
_XSENS = _sided(
    "Pelvis L5 L3 T8 Neck Head",
    "UpperLeg LowerLeg Foot Toe Shoulder UpperArm ForeArm Hand HandMiddle1",
    "{side}{name}",
)
XSENS_NAMES = tuple(name[0].upper() + name[1:] for name in _XSENS)


def arms(x: float, y: float, z: float) -> Array:
    """Return a pose [24, 3], radians: the left shoulder is turned by a rotation vector in degrees, the right one mirrored."""
    pose = np.zeros((24, 3))
    pose[_JOINT["l_shoulder"]], pose[_JOINT["r_shoulder"]] = np.radians((x, y, z)), np.radians((x, -y, -z))
    return pose


def _level() -> Array:
    """Return joints [24, 3] in a T-pose, metres: thighs start at the height of the pelvis, legs and spine are vertical."""
    joints = JOINTS_REST.copy()
    hips = joints[_JOINT["l_hip"]]
    for side, sign in (("l", 1), ("r", -1)):
        for part in ("hip", "knee", "ankle"):
            joints[_JOINT[f"{side}_{part}"]] = (sign * 0.09, joints[_JOINT[f"{side}_{part}"], 1], hips[2])
        joints[_JOINT[f"{side}_foot"], 0] = sign * 0.09
    joints[0] = (0, hips[1], hips[2])
    for name in ("spine1", "spine2", "spine3", "neck", "head"):
        joints[_JOINT[name], 2] = hips[2]
    return joints


@dataclass(frozen=True)
class Convention:
    """How a program writes the motion of a human body."""

    names: tuple[str, ...] = CMU_NAMES
    rest_pose: str = "t"
    """t, a, down, forward or up: the pose in which the joints' frames are those of the world."""
    along: str = ""
    """Axis (x, y, z) of the joints' frames along which the bones of `limbs` lie; empty: frames as above."""
    limbs: tuple[int, ...] = tuple(range(24))
    """Joints whose bones lie along `along`."""
    level_hips: bool = False
    up: str = "y"
    facing_deg: float = 0.0
    scale: float = 100.0
    """Units to a metre."""
    lying: bool = False
    """Whether the rest pose lies on its back."""
    without: tuple[str, ...] = ()
    """Joints that the rig lacks."""
    zero_offsets: bool = False
    """Whether all joints rest at one place, as if their lengths were in the position channels."""
    order: str = "ZXY"
    """Order of rotations in BVH."""
    sole: tuple[float, float, float] | None = None
    """End Sites in BVH; by default forwards, or along the bones."""

    @property
    def end(self) -> tuple[float, float, float]:
        """End Sites in BVH."""
        x, y, z = (float(axis == (self.along or "z")) for axis in "xyz")
        return self.sole or (x, y, z)


CONVENTIONS = {
    "xsens": Convention(XSENS_NAMES, level_hips=True),
    "unreal": Convention(UNREAL_NAMES, "a", level_hips=True, up="z"),
    "rokoko_along_x": Convention(MIXAMO_NAMES, along="x"),
    "bandai_along_y": Convention(along="y", scale=1.0, order="XYZ"),
    "lafan_along_x_level": Convention(along="x", level_hips=True, order="ZYX"),
    "along_z_z_up": Convention(along="z", up="z"),
    "cmu_inches": Convention(scale=39.37),
    "mixamo_t": Convention(MIXAMO_NAMES),
    "arms_down": Convention(rest_pose="down"),
    "arms_down_z_up_turned": Convention(UNREAL_NAMES, "down", up="z", facing_deg=90),
    "arms_down_without_toes": Convention(
        rest_pose="down", level_hips=True, without=("l_foot", "r_foot", "l_hand", "r_hand"), sole=(0.0, -7.0, 0.0)
    ),
    "arms_forward": Convention(MIXAMO_NAMES, "forward", facing_deg=120),
    "arms_up_level": Convention(XSENS_NAMES, "up", level_hips=True, up="z"),
    "legs_along_x": Convention(along="x", limbs=tuple(_LEGS)),
    "limbs_along_x": Convention(MIXAMO_NAMES, along="x", limbs=tuple(_LIMBS), level_hips=True),
    "zero_offsets": Convention(zero_offsets=True, level_hips=True),
    "lying_at_rest": Convention(XSENS_NAMES, "a", lying=True, scale=1000.0),
    "a_pose_turned_back": Convention(SMPL_JOINT_NAMES, "a", facing_deg=180, scale=1.0),
}
"""Conventions by name."""


@dataclass(frozen=True)
class RigMotion:
    """A rig with one clip, and what the clip shows."""

    rig: Rig
    convention: Convention
    rotations: Array
    """[T, 24, 3, 3], world rotations relative to the T-pose, y up, of SMPL's joints."""
    places: Array
    """[T, 24, 3], metres, y up, of SMPL's joints."""


def rig_motion(motion: Motion, convention: Convention) -> RigMotion:
    """Return a motion of SMPL's joints as the rig of a convention."""
    joints = _level() if convention.level_hips else JOINTS_REST
    rotations, places = _posed(motion.poses, motion.translation, joints)
    facing = Rotation.from_euler("y", convention.facing_deg, degrees=True).as_matrix()
    rotations, places = facing @ rotations, places @ facing.T
    poses = {"t": np.zeros((24, 3)), "a": a_pose(), "down": arms(0, 0, -85), "forward": arms(0, -85, 0), "up": arms(0, 0, 80)}
    frames = _posed(poses[convention.rest_pose][None], np.zeros((1, 3)), joints)[0][0].transpose(0, 2, 1)
    world = Rotation.from_euler("x", 90 if convention.up == "z" else 0, degrees=True).as_matrix()
    frames = frames @ (Rotation.from_euler("x", 90, degrees=True).as_matrix() if convention.lying else world).T
    if convention.along:
        frames[list(convention.limbs)] = _bone_frames(joints, "xyz".index(convention.along))[list(convention.limbs)]
    posed = np.tile(np.eye(4), (len(rotations), 24, 1, 1))
    posed[..., :3, :3] = world @ rotations @ frames
    posed[..., :3, 3] = convention.scale * places @ world.T
    rest = np.tile(np.eye(4), (24, 1, 1))
    for joint, parent in enumerate(PARENTS):
        offset = joints[joint] - joints[parent] if parent >= 0 else joints[0]
        if parent >= 0:
            offset = frames[parent].T @ offset
            rest[joint, :3, 3] = rest[parent, :3, 3] + (0 if convention.zero_offsets else convention.scale) * offset
    keep = [joint for joint, name in enumerate(SMPL_JOINT_NAMES) if name not in convention.without]
    rig = Rig(
        tuple(convention.names[joint] for joint in keep),
        tuple(keep.index(PARENTS[joint]) if joint else -1 for joint in keep),
        rest[keep],
        (RigClip("walk", motion.frame_rate, posed[:, keep]),),
    )
    return RigMotion(rig, convention, rotations, places)


def _posed(poses: Array, translation: Array, joints: Array) -> tuple[Array, Array]:
    """Return world rotations [T, 24, 3, 3] and places [T, 24, 3] of a body with these joints at rest."""
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), 24, 3, 3)
    rotations, places = local.copy(), np.empty((len(poses), 24, 3))
    places[:, 0] = joints[0] + translation
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            rotations[:, joint] = rotations[:, parent] @ local[:, joint]
            places[:, joint] = places[:, parent] + rotations[:, parent] @ (joints[joint] - joints[parent])
    return rotations, places


def _bone_frames(joints: Array, axis: int) -> Array:
    """Return frames [24, 3, 3] in the T-pose, one axis of each along its bone; joints without a bone take their parent's."""
    frames = np.empty((24, 3, 3))
    ends = {PARENTS[joint]: joint for joint in reversed(range(24)) if PARENTS[joint] > 0} | {0: 3, 9: 12}
    for joint in range(24):
        is_foot = SMPL_JOINT_NAMES[joint].endswith("foot")
        if joint not in ends and not is_foot:
            frames[joint] = frames[PARENTS[joint]]
            continue
        along = np.array([0.0, 0.0, 1.0]) if is_foot else joints[ends[joint]] - joints[joint]
        along = along / np.linalg.norm(along)
        across = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.7 else np.array([0.0, 1.0, 0.0])
        second = across - (across @ along) * along
        second /= np.linalg.norm(second)
        frame = np.stack([along, second, np.cross(along, second)], 1)
        frames[joint] = np.roll(frame, axis, 1)
    return frames
