"""Write the motion of a human rig as VRM's `.vrm` or `.vrma`: joints without telling names, and the table that names them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from toy_gltf import BOX, GltfBuilder

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.formats.rig import Rig

__all__ = ["VRM_BONES", "human_vrm"]

VRM_BONES = {
    "hips": "pelvis", "spine": "spine1", "chest": "spine2", "upperChest": "spine3", "neck": "neck", "head": "head",
    **{
        f"{long}{bone}": f"{side}_{part}"
        for side, long in (("l", "left"), ("r", "right"))
        for bone, part in {
            "UpperLeg": "hip", "LowerLeg": "knee", "Foot": "ankle", "Toes": "foot", "Shoulder": "collar",
            "UpperArm": "shoulder", "LowerArm": "elbow", "Hand": "wrist", "MiddleProximal": "hand",
        }.items()
    },
}  # fmt: skip
"""SMPL's name of each bone by its name in VRM."""


def human_vrm(rig: Rig, table: str, *, with_mesh: bool = True) -> GltfBuilder:
    """Return a glTF file of a rig of SMPL's joints whose frames at rest are those of the world.

    Args:
        rig: the rig, with one clip.
        table: kind of the table of bones: `VRMC_vrm`, `VRMC_vrm_animation` or `VRM` (version 0).
        with_mesh: whether there is a skin with a box at each joint, as in `.vrm`.
    """
    builder, count = GltfBuilder(), len(rig.names)
    # In the file, the joints come in reverse order, below a node of their own, and beside a node that moves.
    number = {joint: count - joint for joint in range(count)}
    nodes: list[dict] = [{} for _ in range(count + 1)]
    nodes[0] = {"name": "top", "children": [number[0]]}
    for joint, parent in enumerate(rig.parents):
        offset = rig.rest[joint, :3, 3] - (rig.rest[parent, :3, 3] if parent >= 0 else 0)
        nodes[number[joint]] |= {"name": f"thing.{7 * joint % 24}", "translation": offset.tolist()}
        if parent >= 0:
            nodes[number[parent]].setdefault("children", []).append(number[joint])
    nodes.append({"name": "happy"})
    bones = {bone: number[SMPL_JOINT_NAMES.index(part)] for bone, part in VRM_BONES.items()}
    human = {bone: {"node": node} for bone, node in bones.items()}
    if table == "VRM":
        human = [{"bone": bone, "node": node} for bone, node in bones.items()] + [{"bone": "jaw", "node": -1}]
    builder.root.update(nodes=nodes, extensions={table: {"humanoid": {"humanBones": human}}}, animations=[])
    builder.root["scenes"] = [{"nodes": [0, count + 1]}]
    if with_mesh:
        _add_skin(builder, rig, number)
    _add_clip(builder, rig, number)
    return builder


def _add_skin(builder: GltfBuilder, rig: Rig, number: dict[int, int]) -> None:
    count = len(rig.names)
    inverse = np.tile(np.eye(4), (count, 1, 1))
    inverse[:, :3, 3] = -rig.rest[:, :3, 3]
    owner = np.repeat(np.arange(count), len(BOX.vertices))
    positions = np.tile(0.2 * BOX.vertices, (count, 1)) + rig.rest[owner, :3, 3]
    faces = (BOX.faces + len(BOX.vertices) * np.arange(count)[:, None, None]).ravel()
    attributes = {
        "POSITION": builder.array(positions),
        "JOINTS_0": builder.array(np.pad(owner[:, None], ((0, 0), (0, 3))), "uint8"),
        "WEIGHTS_0": builder.array([[1, 0, 0, 0]] * len(owner)),
    }
    builder.root["skins"] = [
        {"joints": [number[joint] for joint in range(count)], "inverseBindMatrices": builder.array(inverse)}
    ]
    builder.root["meshes"] = [{"primitives": [{"attributes": attributes, "indices": builder.array(faces, "uint16")}]}]
    builder.root["nodes"].append({"mesh": 0, "skin": 0})
    builder.root["scenes"][0]["nodes"].append(len(builder.root["nodes"]) - 1)


def _add_clip(builder: GltfBuilder, rig: Rig, number: dict[int, int]) -> None:
    clip = rig.clips[0]
    times = builder.array(np.arange(len(clip.world_from_joint)) / clip.frame_rate)
    happy = len(rig.names) + 1
    tracks = [
        (number[0], "translation", clip.world_from_joint[:, 0, :3, 3]),
        (happy, "translation", np.ones((len(clip.world_from_joint), 3))),
    ]
    for joint, parent in enumerate(rig.parents):
        local = clip.world_from_joint[:, joint, :3, :3]
        if parent >= 0:
            local = clip.world_from_joint[:, parent, :3, :3].transpose(0, 2, 1) @ local
        tracks.append((number[joint], "rotation", Rotation.from_matrix(local).as_quat()))
    builder.root["animations"].append(
        {
            "samplers": [{"input": times, "output": builder.array(values)} for _, _, values in tracks],
            "channels": [{"sampler": n, "target": {"node": node, "path": path}} for n, (node, path, _) in enumerate(tracks)],
        }
    )
