from __future__ import annotations

import json
import os
import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from toy_animal import FRAME_RATE, animal_motion, make_animal
from toy_animal_files import animal_glb
from toy_gltf import BOX, GltfBuilder, two_bones

from snarfcli.errors import UserError
from snarfcli.formats.gltf import read_gltf, read_gltf_surface


def _read(tmp_path, builder, reader=read_gltf, **options):
    path = tmp_path / "file.glb"
    path.write_bytes(builder.glb())
    return reader(path, **options)


def _posed(rig, clip, frame):
    """Move the mesh as the docstring of `RigMesh` says."""
    matrices = clip.world_from_joint[frame] @ np.linalg.inv(rig.rest)
    blended = np.einsum("vj,jab->vab", rig.mesh.weights, matrices)
    return np.einsum("vab,vb->va", blended[:, :3, :3], rig.mesh.vertices) + blended[:, :3, 3]


def test_armature_scale_and_axes_are_undone(tmp_path):
    rig = _read(tmp_path, two_bones())
    assert rig.names == ("bone", "bone_2")
    assert rig.parents == (-1, 0)
    np.testing.assert_allclose(rig.rest[:, :3, 3], [[0, 0.5, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(np.sort(rig.mesh.vertices, 0)[[0, -1]], [[-0.1, 0, -0.1], [0.1, 1, 0.1]], atol=1e-6)
    assert trimesh.Trimesh(rig.mesh.vertices, rig.mesh.faces, process=False).volume == pytest.approx(0.04)
    (clip,) = rig.clips
    assert clip.name == "clip_0"
    assert clip.frame_rate == 30
    assert clip.world_from_joint.shape == (31, 2, 4, 4)
    np.testing.assert_allclose(_posed(rig, clip, 0), rig.mesh.vertices, atol=1e-6)
    turned = rig.mesh.vertices @ Rotation.from_euler("y", 90, degrees=True).as_matrix().T  # z up in the file is y up here
    np.testing.assert_allclose(_posed(rig, clip, 30), turned, atol=1e-6)


def test_bind_pose_that_no_node_stands_in_keeps_scale_and_axes(tmp_path):
    builder = two_bones()
    builder.root["nodes"][3]["rotation"] = Rotation.from_euler("x", 40, degrees=True).as_quat().tolist()
    rig = _read(tmp_path, builder)
    np.testing.assert_allclose(np.sort(rig.mesh.vertices, 0)[[0, -1]], [[-0.1, 0, -0.1], [0.1, 1, 0.1]], atol=1e-6)
    np.testing.assert_allclose(rig.rest[:, :3, 3], [[0, 0.5, 0], [0, 0, 0]], atol=1e-6)


def _reference_skinning(path, animation, time):
    """glTF 2.0, 3.7.3.3 word for word, LINEAR only, from the bytes of a file by `animal_glb`."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    root, binary = json.loads(content[20 : 20 + size]), content[28 + size :]

    def array(number):
        accessor = root["accessors"][number]
        dtype = {5121: "u1", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        start = root["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(binary, dtype, accessor["count"] * width, start).reshape(-1, width)

    state = {n: {"rotation": [0, 0, 0, 1], **node} for n, node in enumerate(root["nodes"])}
    for channel in root["animations"][animation]["channels"]:
        sampler = root["animations"][animation]["samplers"][channel["sampler"]]
        frame = int(np.argmin(np.abs(array(sampler["input"])[:, 0] - time)))
        state[channel["target"]["node"]][channel["target"]["path"]] = array(sampler["output"])[frame]
    world, waiting = {}, [(0, np.eye(4))]
    while waiting:
        node, above = waiting.pop()
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(state[node]["rotation"]).as_matrix()
        local[:3, 3] = state[node]["translation"]
        world[node] = above @ local
        waiting += [(child, world[node]) for child in root["nodes"][node].get("children", [])]
    skin, attributes = root["skins"][0], root["meshes"][0]["primitives"][0]["attributes"]
    inverse = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    matrices = np.stack([world[joint] @ inverse[i] for i, joint in enumerate(skin["joints"])])
    blended = np.einsum("vk,vkab->vab", array(attributes["WEIGHTS_0"]), matrices[array(attributes["JOINTS_0"])])
    return np.einsum("vab,vb->va", blended, np.pad(array(attributes["POSITION"]), ((0, 0), (0, 1)), constant_values=1))[:, :3]


def test_animal_is_skinned_as_the_specification_says(tmp_path):
    animal, motions = make_animal(0.05), [animal_motion(name, 12) for name in ("walk", "sit")]
    path = tmp_path / "animal.glb"
    path.write_bytes(animal_glb(animal, motions))
    rig = read_gltf(path)
    assert (rig.names, rig.parents) == (animal.names, animal.parents)
    assert [clip.name for clip in rig.clips] == ["walk", "sit"]
    np.testing.assert_array_equal(rig.mesh.vertices, animal.vertices)
    np.testing.assert_allclose(rig.mesh.weights.sum(1), 1, atol=1e-12)
    for number, (clip, motion) in enumerate(zip(rig.clips, motions, strict=True)):
        truth = animal.posed(motion)
        for frame in (0, 5, 11):
            np.testing.assert_allclose(_posed(rig, clip, frame), truth[frame], atol=1e-6)
            np.testing.assert_allclose(
                _posed(rig, clip, frame), _reference_skinning(path, number, frame / FRAME_RATE), atol=1e-6
            )
    mesh = trimesh.load(path, force="mesh", process=False)  # the pose of the nodes is the bind pose
    vertices, faces = read_gltf_surface(path)
    np.testing.assert_allclose(vertices[faces], mesh.vertices[mesh.faces], atol=1e-6)


def test_vertices_split_along_seams_are_welded(tmp_path):
    rig = _read(tmp_path, two_bones(indices=False))
    assert rig.mesh.vertices.shape == (8, 3)
    assert trimesh.Trimesh(rig.mesh.vertices, rig.mesh.faces, process=False).is_watertight


def test_touching_parts_with_other_weights_stay_apart(tmp_path):
    builder = two_bones(indices=False)
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = builder.array([[k // 18, 0, 0, 0] for k in range(36)], "uint8")
    rig = _read(tmp_path, builder)
    assert len(rig.mesh.vertices) > 8


def test_two_skins_of_the_same_joints_are_joined(tmp_path):
    builder = two_bones()
    root = builder.root
    # The second mesh is stored in metres, y up: its inverse bind matrices undo the armature.
    bind = np.eye(4)
    bind[:3, :3] = 100 * Rotation.from_euler("x", 90, degrees=True).as_matrix()
    first = np.stack([np.eye(4), np.eye(4)])
    first[1, 2, 3] = -50
    root["skins"].append({"joints": [3, 1], "inverseBindMatrices": builder.array(first @ bind)})
    attributes = {
        "POSITION": builder.array(np.add(BOX.vertices, [1, 0.5, 0])),
        "JOINTS_0": builder.array([[1, 0, 0, 0]] * 8, "uint16"),
        "WEIGHTS_0": builder.array([[1, 0, 0, 0]] * 8),
    }
    indices = builder.array(BOX.faces.ravel(), "uint32")
    root["meshes"].append({"primitives": [{"attributes": attributes, "indices": indices}]})
    root["nodes"].append({"mesh": 1, "skin": 1})
    root["scenes"][0]["nodes"].append(5)
    rig = _read(tmp_path, builder)
    assert rig.mesh.vertices.shape == (16, 3)
    assert len(rig.names) == 2
    np.testing.assert_allclose(np.sort(rig.mesh.vertices, 0)[[0, -1]], [[-0.1, 0, -0.1], [1.1, 1, 0.1]], atol=1e-6)
    vertices, _ = _read(tmp_path, builder, read_gltf_surface)
    np.testing.assert_allclose(np.sort(vertices, 0), np.sort(rig.mesh.vertices, 0), atol=1e-6)


def _robot(**more):
    """Two boxes: 0 carries 2 by way of 1, which has no mesh and turns."""
    builder = GltfBuilder()
    attributes = {"POSITION": builder.array(BOX.vertices)}
    indices = builder.array(BOX.faces.ravel(), "uint8")
    times = builder.array([0.0, 0.5, 1.0])
    builder.root.update(
        nodes=[
            {"name": "base", "mesh": 0, "children": [1]},
            {"name": "arm", "translation": [0, 0.5, 0], "children": [2]},
            {"name": "hand", "mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0.5, 0, 1]},
            {"name": "lamp"},
        ],
        meshes=[{"primitives": [{"attributes": attributes, "indices": indices}]}],
        animations=[
            {
                "name": "wave",
                "samplers": [{"input": times, "output": builder.array([[0, 0, 0], [1, 0, 0], [1, 2, 0]]), **more}],
                "channels": [
                    {"sampler": 0, "target": {"node": 1, "path": "translation"}},
                    {"sampler": 0, "target": {"node": 3, "path": "translation"}},
                    {"sampler": 0, "target": {"node": 3, "path": "weights"}},
                ],
            }
        ],
    )
    return builder


def test_robot_of_rigid_parts(tmp_path):
    rig = _read(tmp_path, _robot(), frame_rate=4.0)
    assert rig.names == ("base", "arm", "hand")
    assert rig.parents == (-1, 0, 1)
    assert rig.mesh.vertices.shape == (16, 3)
    assert set(np.unique(rig.mesh.weights)) == {0.0, 1.0}
    # The second box is mirrored, and must not be inside out.
    assert trimesh.Trimesh(rig.mesh.vertices, rig.mesh.faces, process=False).volume == pytest.approx(0.08)
    (clip,) = rig.clips
    np.testing.assert_allclose(clip.world_from_joint[:, 1, :3, 3], [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 1, 0], [1, 2, 0]])
    np.testing.assert_allclose(clip.world_from_joint[:, 2, :3, 3], clip.world_from_joint[:, 1, :3, 3] + [0, 0.5, 0])
    vertices, faces = _read(tmp_path, _robot(), read_gltf_surface)
    assert len(vertices) == 12  # the boxes share four corners, which are welded although they follow different joints
    assert trimesh.Trimesh(vertices, faces, process=False).area == pytest.approx(2 * BOX.area)


def test_step_holds_and_cubic_spline_follows_its_tangents(tmp_path):
    (clip,) = _read(tmp_path, _robot(interpolation="STEP"), frame_rate=4.0).clips
    np.testing.assert_allclose(clip.world_from_joint[:, 1, :3, 3], [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 2, 0]])
    builder = _robot(interpolation="CUBICSPLINE")
    keys = [[0, 0, 0], [0, 0, 0], [1, 0, 0], [-1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [1, 2, 0], [0, 0, 0]]
    builder.root["animations"][0]["samplers"][0]["output"] = builder.array(keys)
    (clip,) = _read(tmp_path, builder, frame_rate=4.0).clips
    # In the middle of a step of 0.5 s: (p0 + p1) / 2 + 0.5 (m0 - m1) / 8
    np.testing.assert_allclose(clip.world_from_joint[1, 1, :3, 3], [0.5 + 0.5 * 2 / 8, 0, 0], atol=1e-7)
    np.testing.assert_allclose(clip.world_from_joint[4, 1, :3, 3], [1, 2, 0])


def test_rotations_go_the_short_way_round_and_may_be_integers(tmp_path):
    builder = _robot()
    turns = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 120], [0, 0, 200]])).as_quat() * [[1], [-1], [1]]
    output = builder.array(np.round(turns * 32767), "int16", normalized=True)
    builder.root["animations"][0]["samplers"].append({"input": 2, "output": output})
    builder.root["animations"][0]["channels"].append({"sampler": 1, "target": {"node": 1, "path": "rotation"}})
    (clip,) = _read(tmp_path, builder, frame_rate=4.0).clips
    angles = Rotation.from_matrix(clip.world_from_joint[:, 1, :3, :3]).as_euler("zyx", degrees=True)[:, 0] % 360
    np.testing.assert_allclose(angles, [0, 60, 120, 160, 200], atol=0.01)


def test_strips_fans_sparse_and_interleaved_arrays(tmp_path):
    builder = GltfBuilder()
    square = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    mixed = np.concatenate([square, np.full((4, 2), 9, np.float32)], 1)  # each vertex is followed by 8 other bytes
    strip = builder.array(square, bufferView=builder.view(mixed.tobytes(), byteStride=20))
    sparse = {
        "count": 2,
        "indices": {"bufferView": builder.view(b"\1\3"), "componentType": 5121},
        "values": {"bufferView": builder.view(np.float32([[1, 0, 0], [0, 1, 0]]).tobytes())},
    }
    fan = builder.array([[5, 5, 5], [5, 5, 5], [1, 1, 0], [5, 5, 5]])
    builder.root["accessors"][fan]["sparse"] = sparse
    fan_indices = builder.array([0, 1, 2, 3], "uint16")
    primitives = [
        {"attributes": {"POSITION": strip}, "mode": 5},
        {"attributes": {"POSITION": fan}, "indices": fan_indices, "mode": 6},
        {"attributes": {"POSITION": fan}, "mode": 0},
    ]
    builder.root.update(nodes=[{"mesh": 0}], meshes=[{"primitives": primitives}])
    vertices, faces = _read(tmp_path, builder, read_gltf_surface)
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    np.testing.assert_allclose(areas[:2], 0.5)  # same turn
    np.testing.assert_allclose(corners[2:], [[[1, 0, 0], [1, 1, 0], [5, 5, 5]], [[1, 1, 0], [0, 1, 0], [5, 5, 5]]])


def test_second_set_of_joints_counts(tmp_path):
    builder = two_bones()
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    attributes["WEIGHTS_0"] = builder.array([[0.5, 0, 0, 0]] * 8)
    attributes["JOINTS_1"] = builder.array([[0, 1, 0, 0]] * 8, "uint16")
    attributes["WEIGHTS_1"] = builder.array([[16384, 16383, 0, 0]] * 8, "uint16", normalized=True)
    weights = _read(tmp_path, builder).mesh.weights
    np.testing.assert_allclose(np.sort(weights, 1), np.sort([[0.25, 0.75]] * 8, 1), atol=1e-4)


def test_gltf_with_its_buffer_inside_or_beside(tmp_path):
    (tmp_path / "parts").mkdir()
    builder = two_bones()
    expected = _read(tmp_path, builder)
    (tmp_path / "inside.gltf").write_bytes(builder.gltf())
    (tmp_path / "beside.gltf").write_bytes(builder.gltf("parts/the%20buffer.bin"))
    (tmp_path / "parts" / "the buffer.bin").write_bytes(builder.binary)
    for name in ("inside", "beside"):
        rig = read_gltf(tmp_path / f"{name}.gltf")
        np.testing.assert_array_equal(rig.mesh.vertices, expected.mesh.vertices)
        np.testing.assert_array_equal(rig.clips[0].world_from_joint, expected.clips[0].world_from_joint)


@pytest.mark.parametrize(
    "uri",
    ["../secret.bin", "a/../../secret.bin", "/etc/hostname", "file:///etc/hostname", "http://localhost/a.bin", "link.bin",
     "%2e%2e/secret.bin", "..\\secret.bin", "c:secret.bin", "folder/a.bin", ".", "", "a\0b", "gone.bin", "pipe"],
)  # fmt: skip
def test_buffers_elsewhere_are_refused(uri, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\0" * 10_000)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    (folder / "folder").symlink_to(tmp_path)
    (tmp_path / "a.bin").write_bytes(b"\0" * 10_000)
    os.mkfifo(folder / "pipe")
    (folder / "file.gltf").write_bytes(two_bones().gltf(uri or " "))
    with pytest.raises(UserError, match=r"same folder|missing|not a file|cannot be opened") as error:
        read_gltf(folder / "file.gltf")
    assert "file.gltf" in str(error.value)
    assert str(error.value).isprintable()


def _edited(edit):
    builder = two_bones()
    edit(builder)
    return builder


def _set(*keys):
    def edit(builder):
        owner = builder.root
        for key in keys[:-2]:
            owner = owner[key]
        owner[keys[-2]] = keys[-1]

    return edit


def _bad_array(owner, key, values, *path):
    def edit(builder):
        found = builder.root
        for part in (owner, *path):
            found = found[part]
        found[key] = builder.array(values)

    return edit


_SAMPLER = (0, "samplers", 0)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (_set("asset", "version", "1.0"), "wanted 2.0"),
        (_set("extensionsRequired", ["KHR_draco_mesh_compression"]), "Draco"),
        (_set("extensionsRequired", ["EXT_meshopt_compression"]), "meshopt"),
        (_set("bufferViews", 0, "extensions", {"EXT_meshopt_compression": {}}), "meshopt"),
        (_set("nodes", 3, "children", [1]), "two parents"),
        (_set("nodes", 3, "children", [0]), "own ancestor"),
        (_set("nodes", 0, "children", [99]), "there are 5 nodes"),
        (_set("nodes", 0, "children", [True]), "there are 5 nodes"),
        (_set("nodes", 0, "scale", [0, 0, 0]), "joint bone has scale zero"),
        (_set("nodes", 0, "scale", [float("nan"), 1, 1]), "3 finite numbers"),
        (_set("nodes", 0, "rotation", [0, 0, 0, 0]), "zero quaternion"),
        (_set("nodes", 0, "translation", [1, 2]), "3 finite numbers"),
        (_set("accessors", 0, "count", 10**12), "wanted at most 500000 vertices"),
        (_set("accessors", 0, "count", 9), "outside its buffer"),
        (_set("accessors", 0, "count", -1), "an integer of at least 0"),
        (_set("accessors", 0, "byteOffset", 10**12), "outside its buffer"),
        (_set("accessors", 0, "componentType", 5130), "component type"),
        (_set("bufferViews", 0, "byteOffset", 10**6), "outside its buffer"),
        (_set("bufferViews", 0, "byteStride", 4), "outside its buffer"),
        (_set("skins", 0, "joints", []), "no joints"),
        (_set("skins", 0, "joints", [1, 1]), "twice"),
        (_set("skins", 0, "joints", [1]), "beyond the 1 of its skin"),
        (_set("skins", 0, "joints", [1, 3, 0]), "wanted 3 inverse bind matrices, one per joint, got 2"),
        (_set("meshes", 0, "primitives", 0, "attributes", "POSITION", 99), "accessors"),
        (_bad_array("meshes", "POSITION", [[float("nan")] * 3] * 8, 0, "primitives", 0, "attributes"), "NaN"),
        (_bad_array("meshes", "indices", [0.0, 1.0, 2.0], 0, "primitives", 0), "indices"),
        (_bad_array("skins", "inverseBindMatrices", np.zeros((2, 4, 4)), 0), "scale zero"),
        (_bad_array("animations", "input", [0.0, 1e9], *_SAMPLER), "got 1e.09 s"),
        (_bad_array("animations", "input", [1.0, 0.0], *_SAMPLER), "do not increase"),
        (_bad_array("animations", "input", [1.0, 2.0, 3.0], *_SAMPLER), "for 3 times, got 2"),
        (_bad_array("animations", "output", [[0, 0, 0, 0], [0, 0, 0, 1]], *_SAMPLER), "zero quaternion"),
        (_set("animations", 0, "samplers", 0, "interpolation", "MAGIC"), "wanted the interpolation LINEAR"),
        (_set("nodes", {}), "list of objects"),
        (_set("nodes", []), "there are 0 nodes"),
    ],
)
def test_broken_files_are_refused(edit, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        _read(tmp_path, _edited(edit))
    assert "file.glb" in str(error.value)
    assert str(error.value).isprintable()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no valid JSON"),
        (b"glTF\2\0\0\0", "truncated"),
        (b"[" * 100_000, "no valid JSON"),
        (b"[]", "not an object"),
        (b'{"asset": {"version": "2.0"}}', "no skin, no mesh and no animation"),
        (b'{"asset": {"version": ' + b"9" * 5000 + b"}}", "no valid JSON"),
        (two_bones().glb()[:-10], "wanted .* bytes, got"),
        (two_bones().glb()[:4] + b"\1" + two_bones().glb()[5:], "wanted 2, got 1"),
    ],
)
def test_broken_containers_are_refused(content, message, tmp_path):
    (tmp_path / "file.glb").write_bytes(content)
    with pytest.raises(UserError, match=message):
        read_gltf(tmp_path / "file.glb")


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(UserError, match="no glTF file at"):
        read_gltf(tmp_path / "file.glb")
    with pytest.raises(UserError, match="is not a file"):
        read_gltf(tmp_path)


def _turning(times, extras=None, *, ends=None, count=1):
    """Two bones, the upper of which turns, with keys at these times; the other has keys at `ends`."""
    builder = two_bones()
    times = np.asarray(times, np.float64)
    angle = np.linspace(0, 1, len(times)) ** 2
    spin = np.stack([0 * angle, 0 * angle, np.sin(angle), np.cos(angle)], 1)
    samplers = [{"input": builder.array(times), "output": builder.array(spin)}]
    channels = [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}]
    if ends is not None:
        samplers.append({"input": builder.array(ends), "output": builder.array(np.zeros((len(ends), 3)))})
        channels.append({"sampler": 1, "target": {"node": 3, "path": "translation"}})
    builder.root["animations"] = [{"samplers": samplers, "channels": channels, "extras": extras}] * count
    return builder


@pytest.mark.parametrize(
    ("times", "extras", "ends", "rate", "frames"),
    [
        (np.arange(50) / 24, None, None, 24, 50),  # equal steps show the rate
        (3 + np.arange(50) / 24, None, [3, 3 + 49 / 24], 24, 50),
        (np.arange(121) / 120, None, None, 120, 121),
        (np.arange(50) * 1001 / 30000, None, None, 30000 / 1001, 50),
        (np.arange(400_00) / 24, None, None, 24, 400_00),  # long ago, as float32
        ([0, 0.5], {"frame_rate": 24, "frames": 13}, None, 24, 13),  # stands still: what the file says
        (np.arange(7) / 5, {"frame_rate": 5.0}, None, 5, 7),
        ([0.0], {"frame_rate": 24}, None, 24, 1),
        ([0, 0.5, 1], None, None, 30, 31),  # keyed by hand
        ([0, 0.1, 0.15, 1], None, None, 30, 31),
        (np.arange(50) / 24, None, [0, 0.03], 30, 62),
        (np.arange(50) / 24, None, [0, 9], 30, 271),
        # what a file may say without being believed
        (np.arange(25) / 24, {"frame_rate": 23.0}, None, 24, 25),
        (np.arange(25) / 24, {"frame_rate": 960}, None, 24, 25),  # all keys lie on frames, but few frames have any
        (np.arange(25) / 24, {"frame_rate": 0.1}, None, 24, 25),
        ([0, 0.5], {"frame_rate": 1e9}, None, 30, 16),
        ([0, 0.5], {"frame_rate": 10**400}, None, 30, 16),
        ([0, 0.5], {"frame_rate": -24}, None, 30, 16),
        ([0, 0.5], {"frame_rate": float("nan")}, None, 30, 16),
        ([0, 0.5], {"frame_rate": "24"}, None, 30, 16),
        ([0, 0.5], {"frame_rate": True}, None, 30, 16),
        ([0, 0.5], {"frame_rate": [24]}, None, 30, 16),
        ([0, 0.5], [24], None, 30, 16),
        ([0, 1000], {"frame_rate": 1000}, None, 30, 30001),  # too many
    ],
)  # fmt: skip
def test_clips_keep_their_own_frame_rate(tmp_path, times, extras, ends, rate, frames):
    (clip,) = _read(tmp_path, _turning(times, extras, ends=ends)).clips
    assert clip.frame_rate == pytest.approx(rate, rel=1e-6)
    assert len(clip.world_from_joint) == frames


def test_a_rate_that_makes_too_many_samples_gives_way_to_the_usual(tmp_path):
    clips = _read(tmp_path, _turning([0, 90], {"frame_rate": 1000}, count=4)).clips
    assert [(clip.frame_rate, len(clip.world_from_joint)) for clip in clips] == [(30, 2701)] * 4
    clips = _read(tmp_path, _turning([0, 90], {"frame_rate": 24}, count=4), frame_rate=10).clips
    assert [(clip.frame_rate, len(clip.world_from_joint)) for clip in clips] == [(10, 901)] * 4
