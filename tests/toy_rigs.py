"""Motions of SMPL's joints as rigs with the names, rest poses, units and axes of other programs; and as BVH text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.formats.rig import Rig, RigClip
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS, joint_positions

_SIDED_CMU = {
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm",
    "elbow": "ForeArm", "wrist": "Hand", "hand": "FingerBase",
}  # fmt: skip
_SIDED_MIXAMO = _SIDED_CMU | {"hand": "HandMiddle1"}


def _named(middle: dict[str, str], sided: dict[str, str], prefix: str = "") -> tuple[str, ...]:
    full = {"l": "Left", "r": "Right"}
    return tuple(prefix + (middle[name] if name in middle else full[name[0]] + sided[name[2:]]) for name in SMPL_JOINT_NAMES)


CMU_NAMES = _named(
    {"pelvis": "Hips", "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1", "neck": "Neck", "head": "Head"}, _SIDED_CMU
)
MIXAMO_NAMES = _named(
    {"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head"},
    _SIDED_MIXAMO,
    "mixamorig:",
)


def a_pose() -> np.ndarray:
    """Return a pose [24, 3], radians: arms half lowered, legs apart, elbows and knees slightly bent, feet level."""
    pose = np.zeros((24, 3))
    for name, turn in {
        "l_shoulder": (0, 0.1, -0.8), "r_shoulder": (0, -0.1, 0.8), "l_elbow": (0, -0.3, 0), "r_elbow": (0, 0.3, 0),
        "l_hip": (-0.2, 0, 0.25), "r_hip": (-0.2, 0, -0.25), "l_knee": (0.3, 0, 0), "r_knee": (0.3, 0, 0),
        "l_ankle": (-0.1, 0, -0.25), "r_ankle": (-0.1, 0, 0.25),
    }.items():  # fmt: skip
        pose[SMPL_JOINT_NAMES.index(name)] = turn
    return pose


def rig_of(
    poses: np.ndarray,
    translation: np.ndarray,
    names: tuple[str, ...] = SMPL_JOINT_NAMES,
    *,
    rest_pose: np.ndarray | None = None,
    world: Rotation | None = None,
    scale: float = 1.0,
    frame_rate: float = 30.0,
) -> Rig:
    """Return a rig that moves as the average adult of the built-in motions does.

    Args:
        poses: [T, 24, 3] axis-angle.
        translation: [T, 3] metres.
        names: of the 24 joints.
        rest_pose: [24, 3] in which the rig rests; the T-pose by default. Joints' frames are those of the world at rest.
        world: turns the whole world, the rest pose included.
        scale: units to a metre.
    """
    rest_pose = np.zeros((24, 3)) if rest_pose is None else rest_pose
    rest_places, rest_turns = joint_positions(rest_pose[None], np.zeros((1, 3)))
    places, turns = joint_positions(poses, translation)
    world = np.eye(3) if world is None else world.as_matrix()
    rest = np.tile(np.eye(4), (24, 1, 1))
    rest[:, :3, 3] = scale * rest_places[0] @ world.T
    posed = np.tile(np.eye(4), (len(poses), 24, 1, 1))
    posed[..., :3, :3] = world @ turns @ rest_turns[0].transpose(0, 2, 1) @ world.T
    posed[..., :3, 3] = scale * places @ world.T
    return Rig(names, PARENTS, rest, (RigClip("walk", frame_rate, posed),))


def write_bvh(path: Path, rig: Rig, order: str = "ZXY", end: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Path:
    """Write the first clip of a rig whose joints rest in the world's frame as BVH."""
    children: list[list[int]] = [[] for _ in rig.names]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, sequence = ["HIERARCHY"], []

    def add(joint: int, depth: int) -> None:
        sequence.append(joint)
        parent = rig.parents[joint]
        offset = rig.rest[joint, :3, 3] - (rig.rest[parent, :3, 3] if parent >= 0 else 0)
        pad = "\t" * depth
        lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {rig.names[joint]}")
        lines.append(f"{pad}{{\n{pad}\tOFFSET {offset[0]:.9f} {offset[1]:.9f} {offset[2]:.9f}")
        turns = " ".join(f"{axis}rotation" for axis in order)
        lines.append(f"{pad}\tCHANNELS 3 {turns}" if depth else f"{pad}\tCHANNELS 6 Xposition Yposition Zposition {turns}")
        for child in children[joint]:
            add(child, depth + 1)
        if not children[joint]:
            lines.append(f"{pad}\tEnd Site\n{pad}\t{{\n{pad}\t\tOFFSET {end[0]} {end[1]} {end[2]}\n{pad}\t}}")
        lines.append(f"{pad}}}")

    add(0, 0)
    posed = rig.clips[0].world_from_joint
    columns = [posed[:, 0, :3, 3]]
    for joint in sequence:
        local = posed[:, joint, :3, :3]
        if rig.parents[joint] >= 0:
            local = posed[:, rig.parents[joint], :3, :3].transpose(0, 2, 1) @ local
        columns.append(Rotation.from_matrix(local).as_euler(order, degrees=True))
    lines += ["MOTION", f"Frames: {len(posed)}", f"Frame Time: {1 / rig.clips[0].frame_rate:.7f}"]
    lines += [" ".join(f"{value:.9f}" for value in row) for row in np.concatenate(columns, 1)]
    path.write_text("\n".join(lines) + "\n")
    return path


def height() -> float:
    """Metres from feet to head of the average adult at rest."""
    return float(np.ptp(JOINTS_REST[:, 1]))
