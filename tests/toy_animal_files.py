"""Write the toy animal as a rigged GLB, as a folder of posed meshes with its skeleton and poses, and as BVH."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from toy_animal import FRAME_RATE, Animal, AnimalMotion
from toy_gltf import GltfBuilder

__all__ = ["animal_glb", "write_animal_bvh", "write_animal_meshes"]


def animal_glb(animal: Animal, motions: list[AnimalMotion]) -> bytes:
    """Return a rigged GLB: one skin, one mesh, one clip per motion (rotations of all joints, translation of the first)."""
    builder = GltfBuilder()
    count = len(animal.names)
    nodes = []
    for j, name in enumerate(animal.names):
        offset = animal.joints[j] - (animal.joints[animal.parents[j]] if j else 0)
        nodes.append({"name": name, "translation": offset.tolist()})
        if children := [c for c in range(count) if animal.parents[c] == j]:
            nodes[j]["children"] = children
    nodes.append({"name": "animal", "mesh": 0, "skin": 0})
    inverse_bind = np.tile(np.eye(4), (count, 1, 1))
    inverse_bind[:, :3, 3] = -animal.joints
    order = np.argsort(-animal.weights, 1)[:, :4]
    builder.root.update(
        scene=0,
        scenes=[{"nodes": [0, count]}],
        nodes=nodes,
        skins=[{"joints": list(range(count)), "inverseBindMatrices": builder.array(inverse_bind), "skeleton": 0}],
        meshes=[
            {
                "primitives": [
                    {
                        "attributes": {
                            "POSITION": builder.array(animal.vertices),
                            "JOINTS_0": builder.array(order, "uint8"),
                            "WEIGHTS_0": builder.array(np.take_along_axis(animal.weights, order, 1)),
                        },
                        "indices": builder.array(animal.faces.ravel(), "uint32"),
                    }
                ]
            }
        ],
        animations=[_animation(builder, animal, motion) for motion in motions],
    )
    return builder.glb()


def _animation(builder: GltfBuilder, animal: Animal, motion: AnimalMotion) -> dict:
    times = builder.array(np.arange(len(motion.poses)) / FRAME_RATE)
    outputs = [(0, "translation", animal.joints[0] + motion.translation)]
    outputs += [(j, "rotation", Rotation.from_rotvec(motion.poses[:, j]).as_quat()) for j in range(len(animal.names))]
    return {
        "name": motion.name,
        "samplers": [{"input": times, "output": builder.array(values)} for _, _, values in outputs],
        "channels": [{"sampler": s, "target": {"node": j, "path": path}} for s, (j, path, _) in enumerate(outputs)],
    }


def write_animal_meshes(folder: Path, animal: Animal, motions: list[AnimalMotion], suffix: str = ".obj") -> None:
    """Write `<motion>/frame_<number>.obj` (or `.ply`), `<motion>/poses.npz` and `skeleton.npz`; no mesh at rest, no weights."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "skeleton.npz", names=np.array(animal.names), parents=np.array(animal.parents), joints=animal.joints)
    for motion in motions:
        (folder / motion.name).mkdir(exist_ok=True)
        arrays = {"poses": motion.poses.reshape(len(motion.poses), -1), "trans": motion.translation}
        np.savez(folder / motion.name / "poses.npz", mocap_framerate=FRAME_RATE, **arrays)
        for frame, vertices in enumerate(animal.posed(motion)):
            write_mesh(folder / motion.name / f"frame_{frame}{suffix}", vertices, animal.faces)


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write an `.obj`, or a binary `.ply`."""
    if path.suffix == ".obj":
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
        path.write_text("\n".join(lines) + "\n")
        return
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    path.write_bytes("\n".join(header).encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def write_animal_bvh(path: Path, animal: Animal, motion: AnimalMotion) -> None:
    """Write the skeleton and one motion as BVH, in metres, rotations as Z X Y."""
    lines, order = ["HIERARCHY"], []

    def write(joint: int, depth: int) -> None:
        order.append(joint)
        parent = animal.parents[joint]
        offset = animal.joints[joint] - (animal.joints[parent] if parent >= 0 else 0)
        tab = "\t" * depth
        channels = ("" if parent >= 0 else "Xposition Yposition Zposition ") + "Zrotation Xrotation Yrotation"
        lines.extend([f"{tab}{'JOINT' if parent >= 0 else 'ROOT'} {animal.names[joint]}", f"{tab}{{"])
        lines.append(f"{tab}\tOFFSET " + " ".join(f"{value:.9g}" for value in offset))
        lines.append(f"{tab}\tCHANNELS {len(channels.split())} {channels}")
        children = [c for c, p in enumerate(animal.parents) if p == joint]
        for child in children:
            write(child, depth + 1)
        if not children:
            lines.extend([f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET 0 -0.02 0.06", f"{tab}\t}}"])
        lines.append(f"{tab}}}")

    write(0, 0)
    lines += ["MOTION", f"Frames: {len(motion.poses)}", f"Frame Time: {1 / FRAME_RATE:.9g}"]
    for pose, translation in zip(motion.poses, motion.translation, strict=True):
        angles = Rotation.from_rotvec(pose[order]).as_euler("ZXY", degrees=True)
        lines.append(" ".join(f"{value:.9g}" for value in [*(animal.joints[0] + translation), *angles.ravel()]))
    path.write_text("\n".join(lines) + "\n")
