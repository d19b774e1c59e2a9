"""Targets of the fuzzer, one function per reader; a function imports its reader when it is called.

To add a reader, add a function with `@_target` anywhere below: its name is what `tools/fuzz_readers.py --only` takes.
"""

from __future__ import annotations

import random
from collections.abc import Callable

import numpy as np
from fuzz_motion_targets import MOTION_TARGETS
from fuzz_own_targets import OWN_TARGETS
from fuzz_surface_targets import SURFACE_TARGETS
from fuzzing import Target

__all__ = ["TARGETS"]

TARGETS: list[Callable[[], Target]] = [*OWN_TARGETS, *SURFACE_TARGETS, *MOTION_TARGETS]
"""Functions that each return one target with the name of the function."""


def _target(make: Callable[[], Target]) -> Callable[[], Target]:
    TARGETS.append(make)
    return make


@_target
def npz() -> Target:
    import io

    from snarfcli.array_files import read_npz

    def seeds() -> list[bytes]:
        made = []
        for save in (np.savez, np.savez_compressed):
            buffer = io.BytesIO()
            save(buffer, poses=np.linspace(0, 1, 12).reshape(2, 6), gender=np.array("neutral"), trans=np.zeros((2, 3), "f4"))
            made.append(buffer.getvalue())
        return made

    return Target("npz", ".npz", seeds, read_npz)


@_target
def bvh() -> Target:
    from snarfcli.formats.bvh import read_bvh

    def seeds() -> list[bytes]:
        end = "End Site {{ OFFSET 0 {} 0 }} }}"
        arm = "JOINT Arm { OFFSET 0 9 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n" + end.format(1)
        leg = "JOINT Leg { OFFSET 1.5 -8 0\nCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
        leg += end.format(-1)
        root = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        values = " ".join(str(number / 4) for number in range(15))
        motion = "MOTION\nFrames: 3\nFrame Time: 0.0083333\n"
        return [
            f"{root}{arm}\n{leg}\n}}\n{motion}{values}\n{values}\n{values}\n".encode(),
            f"{root}{arm}\n}}\n{motion}".replace("\n", "\r\n").encode() + b"1 2 3 4 5 6 7e0 8 -9.5\r\n" * 3,
            f"{root}}}\n".encode() + b"MOTION\nFrames: 40\nFrame Time: 0\n" + b"0 90 0 0 0 45\n" * 40,
        ]

    return Target("bvh", ".bvh", seeds, read_bvh)


@_target
def gltf() -> Target:
    from toy_animal import animal_motion, make_animal
    from toy_animal_files import animal_glb
    from toy_gltf import GltfBuilder, two_bones

    from snarfcli.formats.gltf import read_gltf

    def robot() -> GltfBuilder:
        builder = GltfBuilder()
        corners = builder.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        faces = builder.array([0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3], "uint16")
        keys = builder.array([[0, 0, 0]] * 2 + [[1, 0, 0]] * 2 + [[0, 0, 1]] * 2)
        samplers = [{"input": builder.array([0.0, 0.5]), "output": keys, "interpolation": "CUBICSPLINE"}]
        builder.root.update(
            scenes=[{"nodes": [0]}],
            nodes=[{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "children": [2]}, {"mesh": 0, "name": "top"}],
            meshes=[{"primitives": [{"attributes": {"POSITION": corners}, "indices": faces, "mode": mode} for mode in (4, 5)]}],
            animations=[{"samplers": samplers, "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}]}],
        )
        return builder

    def crowded() -> GltfBuilder:
        """Three sets of influences, plain values beside compressed ones, a part that is hidden, and a scene of a child."""
        builder = two_bones()
        attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
        for number in (1, 2):
            attributes |= {f"JOINTS_{number}": attributes["JOINTS_0"], f"WEIGHTS_{number}": attributes["WEIGHTS_0"]}
        packed = {"buffer": 0, "byteOffset": 8, "byteLength": 16, "byteStride": 12, "count": 8, "mode": "ATTRIBUTES"}
        builder.root["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": packed}
        clip = builder.root["animations"][0]
        clip["samplers"].append({"input": clip["samplers"][0]["input"], "output": builder.array([[1, 1, 1], [0, 0, 0]])})
        clip["channels"].append({"sampler": 1, "target": {"node": 3, "path": "scale"}})
        builder.root["animations"] = [clip, {**clip, "name": "again"}]
        builder.root["scenes"] = [{"nodes": [1, 4]}]
        return builder

    def seeds() -> list[bytes]:
        animal = animal_glb(make_animal(0.08), [animal_motion("walk", 3), animal_motion("sit", 2)])
        return [animal, robot().glb(), robot().gltf(), crowded().glb()]

    return Target("gltf", ".glb", seeds, read_gltf, _with_broken_json)


@_target
def vrm() -> Target:
    """Characters and animations with a table of bones, read as motions."""
    import numpy as np
    from toy_rigs import a_pose, rig_of
    from toy_vrm import human_vrm

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        rig = rig_of(np.stack([a_pose(), 0.5 * a_pose()]), np.zeros((2, 3)))
        kinds = (("VRMC_vrm", True), ("VRM", True), ("VRMC_vrm_animation", False))
        return [human_vrm(rig, table, with_mesh=with_mesh).glb() for table, with_mesh in kinds]

    return Target("vrm", ".vrm", seeds, read_motion, _with_broken_json)


def _with_broken_json(rng: random.Random, content: bytes) -> bytes:
    """Change one to three values in the JSON of a glTF file; its container stays valid."""
    import json
    import struct

    is_binary = content[:4] == b"glTF"
    size = struct.unpack_from("<I", content, 12)[0] if is_binary else len(content)
    root = json.loads(content[20 : 20 + size] if is_binary else content)
    for _ in range(rng.choice([1, 1, 2, 3])):
        owner, key = root, rng.choice(list(root))
        while isinstance(owner[key], (dict, list)) and owner[key] and rng.random() < 0.9:
            owner = owner[key]
            key = rng.choice(list(owner)) if isinstance(owner, dict) else rng.randrange(len(owner))
        nasty = [-1, 0, 1, 2, 3, 7, 10**6, 10**9, 2**31, 2**63, 10**30, 1e30, 1e-30, 1e308, float("nan"), float("inf"), None,
                 True, "", "x\x1b[2J\u2028", "9" * 3000, [], {}, [[]], [0, 0, 0], [0] * 16, {"node": 0}, "data:,",
                 "/etc/passwd", 5120, 5121, 5125, 5126, "MAT4", "VEC4", "STEP", list(range(300))]  # fmt: skip
        action = rng.random()
        if action < 0.15:
            del owner[key]
        elif action < 0.3 and isinstance(owner, list):
            owner.extend([owner[key]] * rng.choice([1, 2, 1000]))
        elif action < 0.4 and isinstance(owner, dict):
            owner[
                rng.choice(
                    [
                        "skin",
                        "mesh",
                        "children",
                        "matrix",
                        "sparse",
                        "byteStride",
                        "normalized",
                        "uri",
                        "extensions",
                        "humanoid",
                    ]
                )
            ] = owner[key]
        else:
            owner[key] = rng.choice(nasty)
        if not root:
            break
    text = json.dumps(root).encode()
    if not is_binary:
        return text
    text += b" " * (-len(text) % 4)
    rest = content[20 + size :]
    return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


@_target
def pickle() -> Target:
    """Plain data, arrays and sparse matrices in every protocol, and files of Python 2 and chumpy."""
    import pickle
    from pathlib import Path

    import scipy.sparse
    from pickle_damage import damaged

    from snarfcli.formats.pickles import read_pickle

    def seeds() -> list[bytes]:
        content = {
            "smpl_poses": np.linspace(0, 1, 12).reshape(2, 6), "names": ["a", "b"], "00032": "male", "n": (1, 2.5, None, True),
            "text": np.array(["ab", "c"]), "big": np.arange(4, dtype=">i4"), "scalar": np.float32(3), "set": {1, 2},
            "coo": scipy.sparse.coo_matrix(np.eye(2, 3)), "csr": scipy.sparse.csr_matrix(np.eye(2, 3)),
            "objects": np.array([1, "x"], object),
        }  # fmt: skip
        made = [pickle.dumps(content, protocol) for protocol in range(6)]
        return made + [path.read_bytes() for path in sorted((Path(__file__).parent / "bodies" / "golden").glob("*.pkl"))]

    return Target("pickle", ".pkl", seeds, read_pickle, damaged)


@_target
def body() -> Target:
    """Bodies in SMPL's format, as pickles."""
    from pathlib import Path

    from pickle_damage import damaged_body
    from smpl_files import octahedron, pickled, toy

    from snarfcli.bodies import load_body

    def seeds() -> list[bytes]:
        made = [pickled(octahedron()), pickled(toy(3, 4, vertices=8), selected=2), pickled(toy(55, 20, vertices=3), chumpy=())]
        return made + [path.read_bytes() for path in sorted((Path(__file__).parent / "bodies" / "golden").glob("*.pkl"))]

    return Target("body", ".pkl", seeds, load_body, damaged_body)


@_target
def body_npz() -> Target:
    """Bodies in SMPL's format, as archives."""
    import io

    from pickle_damage import damaged_arrays
    from smpl_files import octahedron, toy

    from snarfcli.bodies import load_body

    def saved(arrays: dict) -> bytes:
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        return buffer.getvalue()

    def extra(rng, content: bytes) -> bytes:
        return saved(damaged_arrays(rng, {**octahedron(), "joint_names": np.array(["a", "b"])}))

    return Target("body_npz", ".npz", lambda: [saved(octahedron()), saved(toy(3, 4, vertices=8))], load_body, extra)


@_target
def skeleton() -> Target:
    """Skeletons and poses in JSON."""
    from skeleton_damage import damaged_json, read_both, seeds_json

    return Target("skeleton", ".json", seeds_json, read_both, damaged_json)


@_target
def skeleton_npz() -> Target:
    """Skeletons and poses in archives."""
    from skeleton_damage import damaged_npz, read_both, seeds_npz

    return Target("skeleton_npz", ".npz", seeds_npz, read_both, damaged_npz)


@_target
def surface_gltf() -> Target:
    from snarfcli.formats.gltf import read_gltf_surface

    base = gltf()
    return Target("surface_gltf", ".gltf", base.seeds, read_gltf_surface, base.extra)
