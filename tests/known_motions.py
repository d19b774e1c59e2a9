"""Ten motion files of common kinds; `golden/known_motions.json` keeps what was read from them when it was known to be right."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pose_files import amass_arrays
from scipy.spatial.transform import Rotation
from toy_gltf import GltfBuilder
from toy_rigs import CMU_NAMES, MIXAMO_NAMES, a_pose, rig_of, write_bvh

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.motions import builtin_motion
from snarfcli.motions.motion import Motion

__all__ = ["KNOWN_MOTIONS"]

_BIPED_NAMES = {
    "pelvis": "Bip01 Pelvis", "spine1": "Bip01 Spine", "spine2": "Bip01 Spine1", "spine3": "Bip01 Spine2", "neck": "Bip01 Neck",
    "head": "Bip01 Head", "hip": "Thigh", "knee": "Calf", "ankle": "Foot", "foot": "Toe0", "collar": "Clavicle",
    "shoulder": "UpperArm", "elbow": "Forearm", "wrist": "Hand", "hand": "Finger1",
}  # fmt: skip


def _motion(name: str, seed: int) -> Motion:
    motion = builtin_motion(name, seed, duration_s=0.5)
    return motion.slice(step=6)


def _bvh(folder: Path, name: str, names: tuple[str, ...] = CMU_NAMES, order: str = "ZXY", **options: object) -> Path:
    motion = _motion(name, 3)
    rig = rig_of(motion.poses, motion.translation, names, frame_rate=motion.frame_rate, **options)  # type: ignore[arg-type]
    return write_bvh(folder / f"{name}.bvh", rig, order)


def _biped(folder: Path) -> Path:
    sides = {"l": "Bip01 L ", "r": "Bip01 R "}
    names = (_BIPED_NAMES.get(name) or sides[name[0]] + _BIPED_NAMES[name[2:]] for name in SMPL_JOINT_NAMES)
    turn = Rotation.from_euler("y", 50, degrees=True)
    return _bvh(folder, "deep_squats", tuple(names), "YXZ", world=turn, rest_pose=a_pose())


def _partial(folder: Path) -> Path:
    """A rig without toes and without the middle of the spine, as motion-capture suits have."""
    motion = _motion("running_on_spot", 2)
    rig = rig_of(motion.poses, motion.translation, CMU_NAMES, scale=100)
    left_out = ("l_foot", "r_foot", "spine2")
    keep = [joint for joint, name in enumerate(SMPL_JOINT_NAMES) if name not in left_out]
    parents = [rig.parents[joint] for joint in keep]
    parents = [rig.parents[parent] if parent >= 0 and parent not in keep else parent for parent in parents]
    clip = replace(rig.clips[0], world_from_joint=rig.clips[0].world_from_joint[:, keep])
    indices = tuple(keep.index(parent) if parent >= 0 else -1 for parent in parents)
    part = replace(rig, names=tuple(rig.names[joint] for joint in keep), parents=indices, rest=rig.rest[keep], clips=(clip,))
    return write_bvh(folder / "partial.bvh", part, "XYZ")


def _gltf(folder: Path) -> Path:
    """Mixamo's joints below an armature that is turned and scaled, as Blender writes them."""
    motion = _motion("jumping_jacks", 3)
    rig = rig_of(motion.poses, motion.translation, MIXAMO_NAMES, scale=100)
    builder = GltfBuilder()
    children: list[list[int]] = [[] for _ in rig.names]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            children[parent].append(joint)
    rest = np.diag([0.01, 0.01, 0.01, 1.0]) @ rig.rest
    times = builder.array(np.arange(motion.num_frames) / 10.0)
    posed = rig.clips[0].world_from_joint
    nodes, channels, samplers = [], [], []
    for joint, parent in enumerate(rig.parents):
        local = rig.rest[joint, :3, 3] - (rig.rest[parent, :3, 3] if parent >= 0 else 0)
        nodes.append({"name": rig.names[joint], "translation": local.tolist(), "children": children[joint]})
        turns = posed[:, joint, :3, :3] if parent < 0 else posed[:, parent, :3, :3].transpose(0, 2, 1) @ posed[:, joint, :3, :3]
        samplers.append({"input": times, "output": builder.array(Rotation.from_matrix(turns).as_quat())})
        channels.append({"sampler": joint, "target": {"node": joint, "path": "rotation"}})
    samplers.append({"input": times, "output": builder.array(posed[:, 0, :3, 3])})
    channels.append({"sampler": len(samplers) - 1, "target": {"node": 0, "path": "translation"}})
    for node in nodes:
        if not node["children"]:
            del node["children"]
    nodes.append({"name": "Armature", "children": [0], "scale": [0.01, 0.01, 0.01]})
    builder.root.update(
        scenes=[{"nodes": [len(rig.names)]}],
        scene=0,
        nodes=nodes,
        skins=[
            {
                "joints": list(range(len(rig.names))),
                "inverseBindMatrices": builder.array(np.linalg.inv(rest)),
            }
        ],
        animations=[{"name": "walk", "channels": channels, "samplers": samplers}],
    )
    path = folder / "mixamo.glb"
    path.write_bytes(builder.glb())
    return path


def _amass(folder: Path) -> Path:
    path = folder / "walk_poses.npz"
    np.savez(path, **amass_arrays())
    return path


def _smpl_x_parts(folder: Path) -> Path:
    rng = np.random.default_rng(5)
    arrays = {"root_orient": 3, "pose_body": 63, "pose_hand": 90, "trans": 3}
    path = folder / "parts_stageii.npz"
    np.savez(path, mocap_frame_rate=120.0, **{key: 0.3 * rng.normal(size=(3, width)) for key, width in arrays.items()})
    return path


def _aist(folder: Path) -> Path:
    rng = np.random.default_rng(6)
    content = {
        "smpl_poses": 0.4 * rng.normal(size=(3, 72)),
        "smpl_trans": rng.normal(size=(3, 3)),
        "smpl_scaling": np.array([2.0]),
    }
    path = folder / "gBR_sBM.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def _frames(folder: Path) -> Path:
    motion = _motion("high_kicks", 1)
    place = folder / "frames"
    place.mkdir()
    for frame in range(motion.num_frames):
        np.savez(place / f"{frame}.npz", pose=motion.poses[frame].ravel(), transl=motion.translation[frame])
    return place


KNOWN_MOTIONS: dict[str, Callable[[Path], Path]] = {
    "cmu_t_pose_centimetres": lambda folder: _bvh(folder, "jumping_jacks", scale=100.0),
    "mixamo_a_pose_zyx": lambda folder: _bvh(folder, "punching", MIXAMO_NAMES, "ZYX", rest_pose=a_pose()),
    "smpl_z_up_inches": lambda folder: _bvh(
        folder, "high_kicks", SMPL_JOINT_NAMES, world=Rotation.from_euler("x", 90, degrees=True), scale=39.37
    ),
    "biped_turned_a_pose": _biped,
    "suit_without_toes": _partial,
    "mixamo_below_armature": _gltf,
    "amass": _amass,
    "smpl_x_parts": _smpl_x_parts,
    "aist": _aist,
    "folder_of_frames": _frames,
}
"""Per name, a function that writes the file into a folder and returns its path."""
