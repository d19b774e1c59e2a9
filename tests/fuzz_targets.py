"""Targets of the fuzzer, one function per reader; a function imports its reader when it is called.

To add a reader, add a function with `@_target` anywhere below: its name is what `tools/fuzz_readers.py --only` takes.
"""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable

import numpy as np
from fuzz_own_targets import OWN_TARGETS
from fuzzing import Target

__all__ = ["TARGETS"]

TARGETS: list[Callable[[], Target]] = [*OWN_TARGETS]
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


def _surface_target(name: str, suffix: str, seeds: Callable[[], list[bytes]]) -> Target:
    from snarfcli.formats.surfaces import read_surface

    return Target(name, suffix, seeds, read_surface)


@_target
def surface_obj() -> Target:
    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    return _surface_target(
        "surface_obj",
        ".obj",
        lambda: [
            corners + b"f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n",
            b"# x\r\nmtllib a.mtl\r\no one\r\n" + corners + b"vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3//1 \\\n4\nf -4 -3 -2\n",
        ],
    )


@_target
def surface_off() -> Target:
    return _surface_target(
        "surface_off",
        ".off",
        lambda: [
            b"OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 2 0 3\n",
            b"OFF4 2 0\r0 0 0\r1 0 0 1\r1 1\r0\r0 1 0\r4 0 1\r2 3\r3 0 1 2\r",
            b"NOFF 3 1 0 0 0 0 0 0 1 1 0 0 0 0 1 0 1 0 0 0 1 3 0 1 2",
            b"COFF 4 2 0 # x\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n1 1 0 1 0 0 1\n0 1 0 1 0 0 1\n\n4 0 1 2 3 9 9\n3 0 1 2\n",
        ],
    )


@_target
def surface_ply() -> Target:
    import struct

    head = b"ply\nformat %s 1.0\ncomment TextureFile a.png\nelement vertex 4\nproperty %s x\nproperty %s y\nproperty %s z\n"
    faces = b"property uchar red\nelement face %d\nproperty list uchar int vertex_indices\nend_header\n"

    def seeds() -> list[bytes]:
        corners, made = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], []
        text = b"0 0 0 1\n1 0 0 1\n0 1 0 1\n0 0 1 1\n3 0 2 1\n4 0 1 2 3\n"
        made.append(head % ((b"ascii",) + (b"float",) * 3) + faces % 2 + text)
        for order, code, polygons in (
            (b"binary_little_endian", "<", [(0, 2, 1), (0, 1, 3), (1, 2, 3)]),
            (b"binary_big_endian", ">", [(0, 2, 1), (0, 1, 3, 2), (1, 2, 3)]),
        ):
            content = head % ((order,) + (b"double",) * 3) + faces % len(polygons)
            content += b"".join(struct.pack(f"{code}3dB", *corner, 7) for corner in corners)
            made.append(content + b"".join(struct.pack(f"{code}B{len(p)}i", len(p), *p) for p in polygons))
            made.append(made[-1].replace(b"\n", b"\r\n" if code == ">" else b"\r", 9))
        strips = b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        lists = b"property uchar red\nproperty list uchar float weights\n"
        made.append(
            head % ((b"ascii",) + (b"float",) * 3)
            + lists
            + strips
            + b"0 0 0 1 0\n1 0 0 1 2 .5 .5\n0 1 0 1 0\n0 0 1 1 0\n6 0 1 2 -1 3 1\n"
        )
        return made

    return _surface_target("surface_ply", ".ply", seeds)


@_target
def surface_stl() -> Target:
    import trimesh

    def seeds() -> list[bytes]:
        box = trimesh.creation.box()
        return [box.export(file_type="stl"), box.export(file_type="stl_ascii").encode()]

    return _surface_target("surface_stl", ".stl", seeds)


@_target
def surface_gltf() -> Target:
    from snarfcli.formats.gltf import read_gltf_surface

    base = gltf()
    return Target("surface_gltf", ".gltf", base.seeds, read_gltf_surface, base.extra)


def _point_target(name: str, suffix: str, seeds: Callable[[], list[bytes]], extra=None) -> Target:
    from snarfcli.point_clouds import read_frame

    return Target(name, suffix, seeds, read_frame, extra)


@_target
def points_text() -> Target:
    return _point_target(
        "points_text",
        ".xyz",
        lambda: [
            b"3\nmade by hand\n0 0 0 255 0 0 0 0 1\n1 0 0 255 0 0 0 1 0\n0 1 0 0 0 0 1 0 0\n",
            b"x,y,z,nx,ny,nz\r\n0,0,1,0,0,1\r\n0,1,0,0,1,0\r\n# end\r\n",
            b"// points\n1e-3;2;3\n4;5;6\n-7;.8;9",
        ],
    )


@_target
def points_ply() -> Target:
    import struct

    def seeds() -> list[bytes]:
        names = b"".join(b"property float %s\n" % name for name in (b"x", b"y", b"z", b"nx", b"ny", b"nz"))
        head = b"ply\nformat %s 1.0\nelement vertex 3\n" + names + b"end_header\n"
        numbers = [float(number % 5) for number in range(18)]
        text = b"\n".join(b" ".join(b"%g" % value for value in numbers[row : row + 6]) for row in (0, 6, 12))
        return [head % b"ascii" + text, head % b"binary_little_endian" + struct.pack("<18f", *numbers)]

    return _point_target("points_ply", ".ply", seeds)


@_target
def points_obj() -> Target:
    lines = b"v 0 0 1 1 0 0\nvn 0 0 1\nv 0 1 0\nvn 0 1 0\n"
    return _point_target("points_obj", ".obj", lambda: [lines, b"# x\r\n" + lines + b"v 1 \\\n0 0\n"])


@_target
def points_npz() -> Target:
    import io

    def seeds() -> list[bytes]:
        points, made = _poses(4, 3), []
        for arrays in ({"points": points, "normals": points}, {"vertices": points.astype("f8")}, {"xyz": _poses(3, 6)}):
            buffer = io.BytesIO()
            np.savez(buffer, **arrays)
            made.append(buffer.getvalue())
        return made

    return _point_target("points_npz", ".npz", seeds, _odd_npz)


def _poses(frames: int, width: int):

    return np.linspace(-0.5, 0.5, frames * width, dtype=np.float32).reshape(frames, width)


@_target
def motion_npz() -> Target:
    import io

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        old = {"poses": _poses(2, 156), "trans": np.zeros((2, 3)), "mocap_framerate": 120.0, "gender": b"male"}
        parts = {"root_orient": _poses(3, 3), "pose_body": _poses(3, 63), "pose_hand": _poses(3, 90), "mocap_frame_rate": 60}
        smplx = {"global_orient": _poses(2, 3), "body_pose": _poses(2, 69), "left_hand_pose": _poses(2, 45)}
        matrices = {"poses": np.tile(np.eye(3, dtype=np.float32), (1, 24, 1, 1)), "transl": np.ones((1, 3), "f4")}
        made = []
        for arrays in (old, parts, smplx, matrices, {"pose": _poses(1, 72)[0]}):
            buffer = io.BytesIO()
            (np.savez_compressed if arrays is parts else np.savez)(buffer, **arrays)
            made.append(buffer.getvalue())
        return made

    return Target("motion_npz", ".npz", seeds, read_motion, _odd_npz)


def _odd_npz(rng: random.Random, content: bytes) -> bytes:
    """Return another archive: the arrays of the seed with wrong shapes, types and values."""
    import io

    np.seterr(all="ignore")
    with np.load(io.BytesIO(content)) as archive:
        arrays = {key: archive[key] for key in archive.files}
    for _ in range(rng.choice([1, 1, 2, 3])):
        key = rng.choice(list(arrays))
        array = arrays[key]
        kind = rng.randrange(8)
        if kind == 0:
            array = array.ravel()
        elif kind == 1:
            array = array[None] if rng.random() < 0.5 else array[..., None]
        elif kind == 2:
            kinds = ["S4", "U8", "O"] + ["f2", "f8", "i1", "u8", ">f4", "c8", "?"] * (array.dtype.kind == "f")
            with np.errstate(all="ignore"):
                array = array.astype(rng.choice(kinds))
        elif kind == 3:
            array = np.repeat(array, rng.choice([0, 2, 3]), rng.randrange(array.ndim)) if array.ndim else np.zeros(0)
        elif kind == 4 and array.dtype.kind == "f":
            with np.errstate(all="ignore"):
                array = array * rng.choice([np.nan, np.inf, 1e30, 180.0, 0.0, -1.0, 1e-30])
        elif kind == 5:
            array = np.asfortranarray(array.T)
        elif kind == 6:
            array = np.zeros(rng.choice([(), (0,), (0, 72), (72, 0), (1, 1, 1, 1), (24, 3), (2, 52, 3), (1, 66), (3, 0, 3, 3)]))
        else:
            other = rng.choice(
                ["poses", "pose", "trans", "smpl_scaling", "fps", "root_orient", "pose_body", "smpl_poses", "body_pose", "up",
                 "global_orient", "pose_world", "left_hand_pose", "Rh", "Th", "pred_cam_t", "results", "pred_global_rots"]
            )  # fmt: skip
            arrays[other] = array
            continue
        arrays[key] = array
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@_target
def motion_pkl() -> Target:
    import pickle

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        dance = {"smpl_poses": _poses(2, 72), "smpl_trans": np.ones((2, 3)), "smpl_scaling": np.array([93.5]), "smpl_loss": 0.1}
        plain = {"poses": _poses(1, 72), "trans": np.zeros((1, 3)), "gender": "male"}
        return [pickle.dumps(dance, 2), pickle.dumps(dance, 4), pickle.dumps(plain, 0), pickle.dumps(plain, 5)]

    return Target("motion_pkl", ".pkl", seeds, read_motion)


@_target
def motion_bvh() -> Target:
    import tempfile
    from pathlib import Path

    from toy_rigs import CMU_NAMES, MIXAMO_NAMES, a_pose, rig_of, write_bvh

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        poses = _poses(2, 72).reshape(2, 24, 3).astype(np.float64)
        rigs = [rig_of(poses, np.zeros((2, 3)), CMU_NAMES, scale=100)]
        rigs.append(rig_of(poses, np.ones((2, 3)), MIXAMO_NAMES, rest_pose=a_pose()))
        with tempfile.TemporaryDirectory() as folder:
            return [write_bvh(Path(folder) / "seed.bvh", rig).read_bytes() for rig in rigs]

    return Target("motion_bvh", ".bvh", seeds, read_motion)


@_target
def motion_pt() -> Target:
    """Results of video estimators as `torch.save` writes them, in both formats."""
    import torch
    from estimates import gvhmr, saved

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        poses = _poses(2, 72).reshape(2, 24, 3).astype(np.float64)
        results = gvhmr(poses, np.ones((2, 3)))
        small = {"poses": torch.from_numpy(poses).half(), "fps": torch.tensor(30).bfloat16(), "notes": ["a", (1, 2.5, None)]}
        return [saved(results), saved(results, is_zip=False), saved(small), saved(small, is_zip=False)]

    return Target("motion_pt", ".pt", seeds, read_motion, _odd_pt)


def _odd_pt(rng: random.Random, content: bytes) -> bytes:
    """Return a file of PyTorch whose pickle or storages are damaged; its archive stays valid."""
    import zipfile

    from estimates import rezipped
    from fuzz_damage import DAMAGES
    from pickle_damage import damaged

    if content[:2] != b"PK":
        return damaged(rng, content)
    chosen = rng.choice(["data.pkl", "data.pkl", "data.pkl", "data/", "byteorder"])

    def change(name: str, data: bytes) -> bytes | None:
        if chosen not in name:
            return data
        if chosen == "data.pkl":
            return damaged(rng, data)
        return rng.choice([None, b"", data[: len(data) // 2], data * 3, rng.choice(DAMAGES)(rng, data, b"big")])

    try:
        return rezipped(content, change)
    except zipfile.BadZipFile:
        return content


@_target
def motion_estimate() -> Target:
    """Results of video estimators as pickles, with what joblib and PyTorch write."""
    import pickle

    import torch
    from estimates import wham
    from pickle_damage import damaged

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        poses = _poses(2, 72).reshape(2, 24, 3).astype(np.float64)
        person = wham(poses, np.ones((2, 3)))
        tensors = {key: torch.from_numpy(value).float() for key, value in person.items()}
        pictures = {f"{number}.jpg": {"tid": [1], "smpl": [{"pose": poses[number].ravel()}]} for number in range(2)}
        plain = [pickle.dumps(content, protocol) for content in ({0: person, 1: tensors}, pictures) for protocol in (2, 4)]
        return [*plain, _like_joblib(poses.reshape(2, 72)), zlib.compress(_like_joblib(poses.reshape(2, 72)))]

    return Target("motion_estimate", ".pkl", seeds, read_motion, damaged)


def _like_joblib(array: np.ndarray) -> bytes:
    """Return {0: {"poses": array}} in a defaultdict as joblib writes it: the array's bytes follow its description."""
    import pickle

    state = {"shape": array.shape, "order": "C", "dtype": array.dtype, "allow_mmap": True, "numpy_array_alignment_bytes": 16}
    wrapper = b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81" + pickle.dumps(state, 2)[2:-1] + b"b"
    padded = b"\x05" + b"\xff" * 5 + array.tobytes()
    head = b"\x80\x02ccollections\ndefaultdict\nc__builtin__\ndict\n\x85RK\x00}X\x05\x00\x00\x00poses"
    return head + wrapper + padded + b"ss."


@_target
def motion_mhr() -> Target:
    """Joints of MHR, as SAM 3D Body writes them."""
    import io

    from estimates import mhr_person

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        made = []
        for person in ({key: value[0] for key, value in mhr_person().items()}, mhr_person(frames=3)):
            for content in (person, {"results": np.array([person], object)}):
                buffer = io.BytesIO()
                np.savez(buffer, **content)
                made.append(buffer.getvalue())
        return made

    return Target("motion_mhr", ".npz", seeds, read_motion, _odd_mhr)


def _odd_mhr(rng: random.Random, content: bytes) -> bytes:
    """Return another archive: its arrays, or the pickle in one, are damaged."""

    from estimates import rezipped
    from pickle_damage import damaged

    if b"results.npy" not in content:
        return _odd_npz(rng, content)
    return rezipped(content, lambda _, data: data[:128] + damaged(rng, data[128:]))
